"""How long a search may take, and whether it took all the time it needed."""

from __future__ import annotations

import time


class TimeBudget:
    """`seconds` from now on; None: no limit. `complete` turns False with the first `spent()` after they are over."""

    def __init__(self, seconds: float | None) -> None:
        self.until = None if seconds is None else time.monotonic() + seconds
        self.complete = True

    def spent(self) -> bool:
        """Whether nothing new may begin."""
        over = self.until is not None and time.monotonic() > self.until
        self.complete = self.complete and not over
        return over
