"""A first look at a candidate: from all its starts, under noise that is not its own, over the whole drive and from an
onset on. Rollouts of averaged commands are good enough for it, and several times as fast."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from avtorch.gap.likelihood.candidate import Candidate
from avtorch.gap.likelihood.fit import modes
from avtorch.gap.likelihood.whitener import Whitener
from avtorch.gap.search.onset import allowed, profile, rough
from avtorch.gap.search.starts import one_at_a_time

Float = NDArray[np.float64]

ENOUGH = 0.3
"""Nats a step gains at least, or the look is over."""
_AT_ONCE = 32
_TURNS = 2  # through the parameters one at a time
_WORTH = 4.0  # nats an onset must gain to be looked at
_FAINT = 0.3  # the same where the effect shows over the whole drive: fitted to all of it, it is diluted


@dataclass(frozen=True, eq=False)
class Look:
    """Where a `candidate` came to: `z` (coordinate,), its log joint density `value`, from row `onset` on."""

    candidate: Candidate = field(repr=False)
    z: Float = field(repr=False)
    value: float
    onset: int | None = None


def looks(
    candidate: Candidate,
    white: Whitener,
    starts: Float,
    *,
    onsets: bool = True,
    floor: float = -np.inf,
    keep: int = 2,
    iterations: int = 6,
) -> list[Look]:
    """The best over the whole drive and, where it promises more, the best that sets in later.

    `starts` (start, coordinate); of these the `keep` best are followed. `floor`: the value without any effect.
    """
    whole, late, when = _tried(candidate, white, starts, onsets)
    first = starts[np.argsort(-whole)[:keep]]
    z, value = _best(candidate, white, first, None, iterations)
    found = [Look(candidate, z, value)]
    if not onsets:
        return found
    row, more = rough(white, candidate, z)
    made = []
    if more > (_FAINT if value > floor + _WORTH else _WORTH):
        made.append(_from(candidate, white, z, row))
    beside = one_at_a_time(candidate, z)
    if len(beside):
        _, more_late, more_when = _tried(candidate, white, beside, True)
        starts = np.concatenate([starts, beside])
        late, when = np.concatenate([late, more_late]), np.concatenate([when, more_when])
    k = int(late.argmax())
    if late[k] > max(value, made[0].value if made else -np.inf) + _WORTH:
        made.append(_from(candidate, white, starts[k], int(when[k])))
    if made:
        found.append(max(made, key=lambda look: look.value))
    return found


def closer(look: Look, white: Whitener) -> Look:
    """The same at every row. Means are good enough to find a place, not to tell what it is worth: a controller that
    answers to noise within a group of rows makes a lag look shorter, and a partner worth hundreds of nats."""
    if white.record.group == 1:
        return look
    z, value = modes(look.candidate, white, look.z[None], onset=look.onset, iterations=3, enough=ENOUGH)
    return replace(look, z=z[0], value=float(value[0]))


def _from(candidate: Candidate, white: Whitener, z: Float, onset: int) -> Look:
    """Parameters and onset in turn."""
    value = -np.inf
    for _ in range(2):
        z, value = _best(candidate, white, z[None], onset, 5)
        moved, _ = rough(white, candidate, z)
        if abs(moved - onset) * white.record.dt < 0.5:
            break
        onset = moved
    return Look(candidate, z, value, onset)


def _best(candidate: Candidate, white: Whitener, z: Float, onset: int | None, iterations: int) -> tuple[Float, float]:
    """The best mode from starts `z` (start, coordinate), also of those beside it."""
    found, values = modes(candidate, white, z, onset=onset, iterations=iterations, coarse=True, enough=ENOUGH)
    best, value = found[values.argmax()], float(values.max())
    for _ in range(_TURNS):
        places = one_at_a_time(candidate, best)
        if not len(places):
            break
        errors = candidate.errors(places, onset, coarse=True)
        k = int((white.log_likelihood(errors) - 0.5 * (places**2).sum(1)).argmax())
        found, values = modes(
            candidate, white, places[k : k + 1], onset=onset, iterations=iterations, coarse=True, enough=ENOUGH
        )
        if values[0] < value + 1:
            break
        best, value = found[0], float(values[0])
    return best, value


def rest(candidate: Candidate, white: Whitener, z: Float, onset: int | None) -> Look:
    """Where a candidate comes to rest from `z` (coordinate,), its onset held."""
    best, value = _best(candidate, white, z[None], onset, 6)
    return Look(candidate, best, value, onset)


def _tried(candidate: Candidate, white: Whitener, starts: Float, onsets: bool) -> tuple[Float, Float, Float]:
    """Log joint densities (start,) over the whole drive, with the best onset, and which row that is."""
    record = candidate.record
    within = allowed(record.rows, record.dt)
    measured = record.measured.mean(-1, keepdims=True)
    whole, late, when = [], [], []
    for i in range(0, len(starts), _AT_ONCE):
        z = starts[i : i + _AT_ONCE]
        cost = 0.5 * (z**2).sum(1)
        rows = -0.5 * (white(measured - candidate.rollouts(z, coarse=True)) ** 2).sum((1, 3))
        whole.append(white.constant_of(coarse=True) + rows.sum(1) - cost)
        if not onsets:
            continue
        quiet = -0.5 * (white(measured - candidate.baseline_rollouts(z, coarse=True)) ** 2).sum((1, 3))
        for j, row in enumerate(rows):
            along = profile(quiet[j if len(quiet) > 1 else 0], row)[within]
            late.append(white.constant_of(coarse=True) + float(along.max()) - cost[j])
            when.append(within.start + int(along.argmax()))
    return np.concatenate(whole), np.array(late), np.array(when)
