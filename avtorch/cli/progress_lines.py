"""Progress in plain lines, for a log file or a pipe: how far a command is and how long it will still take."""

from __future__ import annotations

import time

from rich.console import Console

EVERY_S = 10.0
"""Wall-clock time between two lines [s]; a command that takes less prints none."""


class ProgressLines:
    """Called with (done, of), and a stage where there are several, prints a line on `console` every `EVERY_S`.

    What comes before anything is done, such as a simulator that is driven first, tells its own time after a comma: that
    is printed as it begins, and the time left is counted from its end.
    """

    def __init__(self, console: Console, what: str) -> None:
        self.console, self.what = console, what
        self._begun = self._last = time.monotonic()
        self._before: str | None = None

    def left_s(self, done: float, of: float) -> float | None:
        """Time that is left [s] if it goes on as before; None where that is not known yet."""
        if done == 0:
            self._begun = time.monotonic()
        return self._left_s(time.monotonic(), done, of) if 0 < done < of else None

    def _left_s(self, now: float, done: float, of: float) -> float:
        return (now - self._begun) * (of - done) / done

    def __call__(self, done: float, of: float, stage: str | None = None) -> None:
        now = time.monotonic()
        if done == 0:
            self._begun = now
            if stage is not None and "," in stage and stage != self._before:
                self._before, self._last = stage, now
                self.console.print(f"{self.what}: {stage}", markup=False, soft_wrap=True)
        if now - self._last < EVERY_S or not 0 < done < of:
            return
        self._last = now
        left = self._left_s(now, done, of)
        of_what = "" if stage is None else f" ({stage})"
        self.console.print(f"{self.what}: {100 * done / of:.0f} %, about {left:.0f} s left{of_what}", markup=False)
