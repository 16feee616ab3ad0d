"""Image files, one format a file: frames by index, in the row order of the file."""
