"""`python -m avtorch.cli`."""

import sys

from avtorch.cli.process import run

if __name__ == "__main__":
    sys.exit(run())
