"""An alarm that a monitor raised on the same drives, for the picture of a diagnosis."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Alarm:
    """An alarm of `detector` that began `at` [s] from the start of log number `log`, when its window ended."""

    at: float
    detector: str
    log: int = 0
