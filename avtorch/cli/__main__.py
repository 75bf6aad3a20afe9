"""`python -m avtorch.cli`."""

import sys

from avtorch.cli.app import process

if __name__ == "__main__":
    sys.exit(process())
