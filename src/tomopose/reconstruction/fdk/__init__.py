"""Filtered back-projection: the source's path, the weights of lines measured more than once, the filter."""
