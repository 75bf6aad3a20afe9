"""Whether a program runs in a notebook, and how an answer is shown in either place."""

from __future__ import annotations

import sys
from importlib import import_module
from types import ModuleType


def notebook_display() -> ModuleType | None:
    """`IPython.display` where a notebook's kernel runs this program; None elsewhere."""
    shell = getattr(sys.modules.get("IPython"), "get_ipython", lambda: None)()
    # the shell of a terminal has no kernel and shows neither pictures nor HTML
    return import_module("IPython.display") if hasattr(shell, "kernel") else None


def show(*answers: object) -> None:
    """Display answers below the cell in a notebook, as its last line would; elsewhere print them.

    Example:
        >>> from avtorch import Leader, simulate
        >>> from avtorch.display import show
        >>> log = simulate(Leader.default(start=30.0, duration=60.0, dt=0.05)).log()
        >>> show(log.overview().title)  # of the log itself a notebook shows a small table
        Log arrays: 1200 rows, 59.95 s at 20 Hz, 1 segment
    """
    display = notebook_display()
    for answer in answers:
        if display is None:
            print(answer if isinstance(answer, str) else repr(answer))
        else:
            display.display(answer)
