"""The command line as a process of its own, as the installed `avtorch` starts it.

Python looks for unreachable objects again and again while torch and matplotlib are imported, and once more for all of
them when the process ends. Modules stay until the end, so none is ever found; the search took a fifth of the time of a
short command.
"""

from __future__ import annotations

import gc

from avtorch.cli.app import main

NEW_OBJECTS = 50_000
"""More objects made than freed between two searches; Python's own hundreds suit programs that import less."""


def run() -> int:
    """`main` with the arguments of the process; returns its exit code."""
    gc.set_threshold(NEW_OBJECTS, *gc.get_threshold()[1:])
    try:
        return main()
    finally:
        gc.freeze()  # no last search: the system takes the memory back
