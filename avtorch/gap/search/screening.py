"""Screening of a hypothesis: fits from all its starts, under the noise of another model, over the whole drive and from
an onset on. Rollouts of averaged commands are accurate enough for it, and several times as fast."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from avtorch.arrays import FloatArray
from avtorch.gap.likelihood.gauss_newton import modes
from avtorch.gap.likelihood.hypothesis import Hypothesis
from avtorch.gap.likelihood.whitening_filter import WhiteningFilter
from avtorch.gap.search.initial_values import one_at_a_time
from avtorch.gap.search.onset import allowed, onset_profile, rough_onset

ENOUGH = 0.3
"""Least gain of a step [nats]; a smaller one ends the screening fit."""
_AT_ONCE = 32
_TURNS = 2  # passes through the parameters one at a time
_WORTH = 4.0  # least gain [nats] of an onset for a fit from it
_FAINT = 0.3  # the same where the effect gains over the whole drive, over which a late effect is diluted


@dataclass(frozen=True, eq=False)
class Screened:
    """Screening fit of a `hypothesis`: `z` (coordinate,), its log joint density `value`, from row `onset` on."""

    hypothesis: Hypothesis = field(repr=False)
    z: FloatArray = field(repr=False)
    value: float
    onset: int | None = None


def screen(
    hypothesis: Hypothesis,
    white: WhiteningFilter,
    starts: FloatArray,
    *,
    onsets: bool = True,
    floor: float = -np.inf,
    keep: int = 2,
    iterations: int = 6,
) -> list[Screened]:
    """The best fit over the whole drive and, where it may gain more, the best fit with a later onset.

    `starts` (start, coordinate); the `keep` best are refined. `floor`: the value without any effect.
    """
    whole, late, when = _tried(hypothesis, white, starts, onsets)
    first = starts[np.argsort(-whole)[:keep]]
    z, value = _best(hypothesis, white, first, None, iterations)
    found = [Screened(hypothesis, z, value)]
    if not onsets:
        return found
    row, more = rough_onset(white, hypothesis, z)
    made = []
    if more > (_FAINT if value > floor + _WORTH else _WORTH):
        made.append(_from(hypothesis, white, z, row))
    beside = one_at_a_time(hypothesis, z)
    if len(beside):
        _, more_late, more_when = _tried(hypothesis, white, beside, True)
        starts = np.concatenate([starts, beside])
        late, when = np.concatenate([late, more_late]), np.concatenate([when, more_when])
    k = int(late.argmax())
    if late[k] > max(value, made[0].value if made else -np.inf) + _WORTH:
        made.append(_from(hypothesis, white, starts[k], int(when[k])))
    if made:
        found.append(max(made, key=lambda look: look.value))
    return found


def refine(look: Screened, white: WhiteningFilter) -> Screened:
    """The fit refined at single rows. Group means are accurate enough for a start, not for a score: a controller that
    responds to noise within a group of rows makes a lag appear shorter, and a second effect gain hundreds of nats."""
    if white.record.group == 1:
        return look
    z, value = modes(look.hypothesis, white, look.z[None], onset=look.onset, iterations=3, enough=ENOUGH)
    return replace(look, z=z[0], value=float(value[0]))


def _from(hypothesis: Hypothesis, white: WhiteningFilter, z: FloatArray, onset: int) -> Screened:
    """Fit parameters and onset alternately."""
    value = -np.inf
    for _ in range(2):
        z, value = _best(hypothesis, white, z[None], onset, 5)
        moved, _ = rough_onset(white, hypothesis, z)
        if abs(moved - onset) * white.record.dt < 0.5:
            break
        onset = moved
    return Screened(hypothesis, z, value, onset)


def _best(
    hypothesis: Hypothesis, white: WhiteningFilter, z: FloatArray, onset: int | None, iterations: int
) -> tuple[FloatArray, float]:
    """The best mode from starts `z` (start, coordinate), also from starts that differ in one parameter."""
    found, values = modes(hypothesis, white, z, onset=onset, iterations=iterations, coarse=True, enough=ENOUGH)
    best, value = found[values.argmax()], float(values.max())
    for _ in range(_TURNS):
        places = one_at_a_time(hypothesis, best)
        if not len(places):
            break
        errors = hypothesis.errors(places, onset, coarse=True)
        k = int((white.log_likelihood(errors) - 0.5 * (places**2).sum(1)).argmax())
        found, values = modes(
            hypothesis, white, places[k : k + 1], onset=onset, iterations=iterations, coarse=True, enough=ENOUGH
        )
        if values[0] < value + 1:
            break
        best, value = found[0], float(values[0])
    return best, value


def converge(hypothesis: Hypothesis, white: WhiteningFilter, z: FloatArray, onset: int | None) -> Screened:
    """The mode of a hypothesis reached from `z` (coordinate,), with its onset held."""
    best, value = _best(hypothesis, white, z[None], onset, 6)
    return Screened(hypothesis, best, value, onset)


def _tried(
    hypothesis: Hypothesis, white: WhiteningFilter, starts: FloatArray, onsets: bool
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Log joint densities (start,) over the whole drive, those with the best onset, and the row of that onset."""
    record = hypothesis.record
    within = allowed(record.rows, record.dt)
    measured = record.measured.mean(-1, keepdims=True)
    whole, late, when = [], [], []
    for i in range(0, len(starts), _AT_ONCE):
        z = starts[i : i + _AT_ONCE]
        cost = 0.5 * (z**2).sum(1)
        rows = -0.5 * (white(measured - hypothesis.rollouts(z, coarse=True)) ** 2).sum((1, 3))
        whole.append(white.constant_of(coarse=True) + rows.sum(1) - cost)
        if not onsets:
            continue
        quiet = -0.5 * (white(measured - hypothesis.baseline_rollouts(z, coarse=True)) ** 2).sum((1, 3))
        for j, row in enumerate(rows):
            along = onset_profile(quiet[j if len(quiet) > 1 else 0], row)[within]
            late.append(white.constant_of(coarse=True) + float(along.max()) - cost[j])
            when.append(within.start + int(along.argmax()))
    return np.concatenate(whole), np.array(late), np.array(when)
