"""The command line. It reads arguments, shows progress and tables, and leaves the work to the rest of avtorch."""

from avtorch.cli.app import main

__all__ = ["main"]
