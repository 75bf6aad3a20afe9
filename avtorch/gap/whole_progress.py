"""How far a whole diagnosis is, from the steps of its stages: each has the share of the time that it usually takes."""

from __future__ import annotations

from collections.abc import Callable, Mapping

Progress = Callable[[str, int, int], None]

STEPS = 1000
"""Steps of a whole diagnosis."""

_SPANS: Mapping[str, tuple[float, float]] = {
    "recorder": (0.0, 0.1),
    "outliers": (0.1, 0.15),
    "effects": (0.15, 0.8),
    "average": (0.8, 0.9),
    "held-out blocks": (0.9, 1.0),
}


class WholeProgress:
    """Takes (what, done, of) of a stage; calls `progress` with the whole's instead, which never goes back."""

    def __init__(self, progress: Progress) -> None:
        self._progress = progress
        self._furthest = 0.0

    def __call__(self, what: str, done: int, of: int) -> None:
        begin, end = _SPANS.get(what, (0.0, 0.0))
        self._furthest = max(self._furthest, begin + (end - begin) * done / max(of, 1))
        self._progress(what, round(STEPS * self._furthest), STEPS)
