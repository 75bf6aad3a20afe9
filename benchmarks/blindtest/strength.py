"""The strength at which a cause has a given visibility: a search in which each trial simulates one drive."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TypeVar

from benchmarks.blindtest.visibility import TIERS

T = TypeVar("T")
_TRIALS = 9
_DOMINANT = 12.0  # visibility of the strongest cases drawn


def excess_range(tier: str) -> tuple[float, float]:
    """The `excess` (cause over noise) of a tier; the easy tier ends at visibility 12."""
    low, high = TIERS[tier]
    return math.sqrt(low**2 - 1), math.sqrt(min(high, _DOMINANT) ** 2 - 1)


def solve_strength(
    trial: Callable[[float], tuple[float, T]], aim: float, low: float, high: float, *, begin: float, strongest: float
) -> T | None:
    """The trial whose excess falls in [`low`, `high`), near `aim`; None where no strength up to `strongest` reaches it.

    `trial(strength)` returns the excess and the trial's result; `begin` is the first strength tried. The excess is
    roughly proportional to the strength: the next strength is first scaled in proportion, then interpolated
    logarithmically between the nearest two trials.
    """
    strength = min(begin, strongest)
    below: tuple[float, float] | None = None
    above: tuple[float, float] | None = None
    for _ in range(_TRIALS):
        excess, made = trial(strength)
        if low <= excess < high:
            return made
        if excess < low:
            if strength >= strongest:
                return None
            below = (strength, excess)
        else:
            above = (strength, excess)
        if below and above:
            (s0, e0), (s1, e1) = below, above
            share = math.log(aim / max(e0, 1e-9)) / math.log(e1 / max(e0, 1e-9)) if e1 > e0 else 0.5
            strength = s0 * (s1 / s0) ** min(max(share, 0.15), 0.85)
        else:
            strength = min(strongest, strength * min(max(aim / max(excess, 1e-9), 0.02), 20.0))
    return None
