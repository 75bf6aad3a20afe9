"""`python -m avtorch.cli`."""

import sys

from avtorch.cli.app import main

if __name__ == "__main__":
    sys.exit(main())
