"""The one error a user meets for bad input."""

from __future__ import annotations


class InputError(ValueError):
    """Bad input, told in one line: the argument, or the file, row and column; what was found; what would be right.

    The command line prints the message to stderr and exits with code 2.
    """
