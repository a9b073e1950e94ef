"""`python -m steelnb`: the command line."""

import sys

from steelnb.cli import main

if __name__ == "__main__":
    sys.exit(main())
