"""`python -m tomopose`: the same as the `tomopose` command."""

from tomopose.cli.main import main

if __name__ == "__main__":
    main()
