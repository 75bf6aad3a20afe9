"""How far a whole diagnosis is, from the steps of its stages.

Each stage has the share of the time that it usually takes. How many rounds the budget needs is not known beforehand:
each takes half of what is left of its stage.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

Progress = Callable[[str, int, int], None]

STEPS = 1000
"""Steps of a whole diagnosis."""

_SPANS: Mapping[str, tuple[float, float]] = {
    "single effects": (0.0, 0.3),
    "best effects": (0.3, 0.45),
    "pairs": (0.45, 0.65),
    "random effects": (0.65, 0.7),
    "budget": (0.7, 1.0),
    "held-out folds": (0.75, 1.0),
}
_IN_ROUNDS = "budget"


class WholeProgress:
    """Takes (what, done, of) of a stage, named by `what` up to a comma; calls `progress` with the whole's instead.

    The whole never goes back; a stage that is made again, or that nobody expects, leaves it where it is.
    """

    def __init__(self, progress: Progress) -> None:
        self._progress = progress
        self._furthest, self._rounds, self._done = 0.0, 0, 0

    def __call__(self, what: str, done: int, of: int) -> None:
        stage = what.partition(",")[0]
        begin, end = _SPANS.get(stage, (0.0, 0.0))
        if stage == _IN_ROUNDS:
            self._rounds += done < self._done
            self._done = done
            left = (end - begin) / 2**self._rounds
            begin, end = end - left, end - left / 2
        self._furthest = max(self._furthest, begin + (end - begin) * done / max(of, 1))
        self._progress(what, round(STEPS * self._furthest), STEPS)
