"""From when on: the row at which a cause sets in, found by running sums of likelihoods with and without it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from avtorch.gap.candidate import Candidate
from avtorch.gap.fit import log_joint
from avtorch.gap.innovations import Whitener

Float = NDArray[np.float64]

_PLACES, _HALVINGS = 10, 5  # where a slope is first asked, and how often between the best and those beside it
_NEAREST_S = 4.0  # an onset this close to the start or the end is none


def profile(without: Float, with_cause: Float) -> Float:
    """Log likelihood (row,) if the cause sets in at each row, from those of single rows (row,)."""
    before = np.concatenate([[0.0], np.cumsum(without)[:-1]])
    after = np.cumsum(with_cause[::-1])[::-1]
    return before + after


def allowed(rows: int, dt: float) -> slice:
    """Rows at which a cause can be said to set in."""
    edge = min(round(_NEAREST_S / dt), rows // 4)
    return slice(edge, rows - edge)


def rough(white: Whitener, candidate: Candidate, z: Float) -> tuple[int, float]:
    """Best onset row for parameters `z` of a fit over the whole drive, and what it gains [nats] over none."""
    if candidate.grade_means is not None:
        return _along_the_road(white, candidate, z)
    full = candidate.errors(z[None], coarse=True)[0]
    silent = candidate.record.measured.mean(-1, keepdims=True) - candidate.baseline_rollouts(z[None], coarse=True)[0]
    rows = profile(-0.5 * (white(silent) ** 2).sum((0, 2)), -0.5 * (white(full) ** 2).sum((0, 2)))
    within = allowed(len(rows), white.record.dt)
    best = within.start + int(np.argmax(rows[within]))
    return best, float(rows[best] - rows[0])


def refined(white: Whitener, candidate: Candidate, z: Float, onset: int) -> tuple[int, Float]:
    """Best onset row near `onset`, and the log likelihood over all rows tried, (row,), -inf elsewhere."""
    record = white.record
    if candidate.grade_means is not None:
        return _beside(white, candidate, z, onset)
    within = allowed(record.rows, record.dt)
    found = np.full(record.rows, -np.inf)
    for reach in (8.0, 1.5):
        steps = np.unique(np.round(np.linspace(-reach, reach, 17) / record.dt).astype(int))
        tries = np.unique(np.clip(onset + steps, within.start, within.stop - 1))
        tries = tries[np.isneginf(found[tries])]
        if not len(tries):
            continue
        errors = np.stack([candidate.errors(z[None], int(t), coarse=True)[0] for t in tries])
        found[tries] = white.log_likelihood(errors)
        onset = int(np.argmax(found))
    return onset, found


def _along_the_road(white: Whitener, candidate: Candidate, z: Float) -> tuple[int, float]:
    """`rough` for a slope, which is flat where it does not act: what an onset spares is the prior of its coefficients.

    By the density with the slope integrated out, at some places and then between them.
    """
    within = allowed(candidate.record.rows, candidate.record.dt)
    step = (within.stop - 1 - within.start) / (_PLACES - 1)
    found = {int(row): 0.0 for row in np.linspace(within.start, within.stop - 1, _PLACES)}
    tries = list(found)
    for _ in range(_HALVINGS):
        found |= {row: log_joint(candidate, white, z, row, coarse=True) for row in tries}
        best = max(found, key=lambda row: found[row])
        step *= 0.5
        tries = [int(np.clip(best + s * step, within.start, within.stop - 1)) for s in (-1, 1)]
    return best, found[best] - log_joint(candidate, white, z, coarse=True)


def _beside(white: Whitener, candidate: Candidate, z: Float, onset: int) -> tuple[int, Float]:
    """`refined` for a slope."""
    record = candidate.record
    within = allowed(record.rows, record.dt)
    found = np.full(record.rows, -np.inf)
    for reach in (4.0, 1.0):
        for s in (-1.0, -0.5, 0.0, 0.5, 1.0):
            row = int(np.clip(onset + round(s * reach / record.dt), within.start, within.stop - 1))
            if np.isneginf(found[row]):
                found[row] = log_joint(candidate, white, z, row, coarse=True)
        onset = int(np.argmax(found))
    return onset, found


def averaged(found: Float, dt: float) -> float:
    """What not knowing the onset costs [nats]: mean over a uniform prior against the best row."""
    tried = np.flatnonzero(np.isfinite(found))
    if len(tried) < 2:
        return -float(np.log(len(found)))
    best = found[tried].max()
    # between rows tried the likelihood is taken to run straight
    rows = np.arange(tried[0], tried[-1] + 1)
    inside = np.interp(rows, tried, np.exp(found[tried] - best))
    return float(np.log(max(inside.sum(), 1.0) / len(found)))
