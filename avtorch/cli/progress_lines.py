"""Progress in plain lines, for a log file or a pipe: how far a command is and how long it will still take."""

from __future__ import annotations

import time

from rich.console import Console

EVERY_S = 10.0
"""Wall-clock time between two lines [s]; a command that takes less prints none."""


class ProgressLines:
    """Called with (done, of), prints a line on `console` every `EVERY_S`."""

    def __init__(self, console: Console, what: str) -> None:
        self.console, self.what = console, what
        self._begun = self._last = time.monotonic()

    def __call__(self, done: float, of: float) -> None:
        now = time.monotonic()
        if now - self._last < EVERY_S or not 0 < done < of:
            return
        self._last = now
        left = (now - self._begun) * (of - done) / done
        self.console.print(f"{self.what}: {100 * done / of:.0f} %, about {left:.0f} s left", markup=False)
