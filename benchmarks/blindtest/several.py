"""How strong causes are drawn: one at the visibility of its tier, three to five at once as real cars have them.

Nobody tunes the sizes of several to a tier of visibility: each has the strength of an ordinary car, between 0.6 and 1.6
of the middle, and is one of the case's causes if it can be seen on the drive at all, alone. In every fifth case one of
the causes is outside the table.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import TypeVar

import numpy as np

from avtorch.errors import InputError
from benchmarks.blindtest.catalogue import EFFECTS, Family
from benchmarks.blindtest.drives import DrivePlan
from benchmarks.blindtest.visibility import TIERS

T = TypeVar("T")
COUNTS = (3, 4, 5)
STRENGTHS = (0.6, 1.6)
LEAST_GAP = 1.5
"""Rollout error over its floor, of a case whose gap can be divided."""
_OUTSIDE = 0.2
_LEAST = "hard"  # the tier that each cause reaches, alone on the drive
_TOO_FAINT = {"command_hold"}  # at any strength, beside others


def draw_several(
    rng: np.random.Generator, effects: Sequence[str], group: Mapping[str, Family]
) -> tuple[list[Family], int]:
    """Families in the order in which they are tried, of which the first ones that can be seen are the causes; how many
    causes. A family of `group`, outside the table, is the first of every fifth case."""
    able = sorted(set(effects) - _TOO_FAINT)
    if len(able) < max(COUNTS):
        raise InputError(f"effects: found {tuple(effects)}, several at once need five that are not command_hold")
    count = int(rng.choice(COUNTS))
    order = [EFFECTS[name] for name in rng.permutation(able).tolist()]
    if rng.random() < _OUTSIDE:
        order.insert(0, list(group.values())[int(rng.integers(len(group)))])
    return order, count


def ordinary(
    rng: np.random.Generator,
    families: Sequence[Family],
    count: int,
    drive: DrivePlan,
    at_strength: Callable[[Family, float], T],
    excess: Callable[[T], float],
) -> list[T] | None:
    """Trials of the first `count` of the `families` that can be seen on the drive; None where fewer can.

    `at_strength(family, strength)` simulates the drive with one of them alone, `excess` is that trial's visibility. A
    cause outside the table is among them, or there is no case. At least two can be predicted: else no rollout has a gap
    to divide.
    """
    least, _ = excess_range(_LEAST)
    low, high = STRENGTHS
    strengths = np.exp(rng.uniform(np.log(low), np.log(high), len(families)))
    found: list[T] = []
    predictable = 0
    for f, strength in zip(families, strengths.tolist(), strict=True):
        trial = None
        if not f.suits or drive.manoeuvre in f.suits:
            trial = at_strength(f, min(strength, f.strongest))
        if trial is not None and excess(trial) >= least:
            found.append(trial)
            predictable += not f.by_chance
        elif f.name not in EFFECTS:
            return None
        if len(found) == count:
            return found if predictable >= 2 else None
    return None


# The strength at which a cause has a given visibility: a search in which each trial simulates one drive.
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
