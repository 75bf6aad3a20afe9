"""Cases with three to five causes of ordinary size at once, as real cars have them.

Nobody tunes their sizes to a tier of visibility: each has the strength of an ordinary car, between 0.6 and 1.6 of the
middle, and is one of the case's causes if it can be seen on the drive at all, alone. In every fifth case one of the
causes is outside the table.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TypeVar

import numpy as np

from avtorch.errors import InputError
from benchmarks.blindtest.catalogue import EFFECTS, Family
from benchmarks.blindtest.drives import DrivePlan
from benchmarks.blindtest.strength import excess_range

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
