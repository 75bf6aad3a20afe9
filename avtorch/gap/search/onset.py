"""The onset of a cause: the row found by running sums of likelihoods with and without it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from avtorch.arrays import FloatArray
from avtorch.gap.likelihood.gauss_newton import grade_marginal
from avtorch.gap.likelihood.grade_marginal import GradeMarginal
from avtorch.gap.likelihood.hypothesis import Hypothesis
from avtorch.gap.likelihood.whitening_filter import WhiteningFilter

_PLACES = 12  # rows in the first round of the search for a road grade's onset
_NEAREST_S = 4.0  # an onset closer to the start or the end is not distinguished from none


def onset_profile(without: FloatArray, with_cause: FloatArray) -> FloatArray:
    """Log likelihood (row,) of an onset at each row, from those of single rows (row,) without and with the cause."""
    before = np.concatenate([[0.0], np.cumsum(without)[:-1]])
    after = np.cumsum(with_cause[::-1])[::-1]
    return before + after


def allowed(rows: int, dt: float) -> slice:
    """Rows at which an onset is allowed."""
    edge = min(round(_NEAREST_S / dt), rows // 4)
    return slice(edge, rows - edge)


def rough_onset(white: WhiteningFilter, hypothesis: Hypothesis, z: FloatArray) -> tuple[int, float]:
    """Best onset row for parameters `z` of a fit over the whole drive, and its gain [nats] over no onset."""
    if hypothesis.grade_means is not None:
        return _Road.of(white, hypothesis, z).best(allowed(hypothesis.record.rows, white.record.dt))
    full = hypothesis.errors(z[None], coarse=True)[0]
    silent = hypothesis.record.measured.mean(-1, keepdims=True) - hypothesis.baseline_rollouts(z[None], coarse=True)[0]
    rows = onset_profile(-0.5 * (white(silent) ** 2).sum((0, 2)), -0.5 * (white(full) ** 2).sum((0, 2)))
    within = allowed(len(rows), white.record.dt)
    best = within.start + int(np.argmax(rows[within]))
    return best, float(rows[best] - rows[0])


def refined_onset(white: WhiteningFilter, hypothesis: Hypothesis, z: FloatArray, onset: int) -> tuple[int, FloatArray]:
    """Best onset row near `onset`, and the log likelihood over all rows tried, (row,), -inf elsewhere."""
    record = white.record
    within = allowed(record.rows, record.dt)
    road = None if hypothesis.grade_means is None else _Road.of(white, hypothesis, z)
    found = np.full(record.rows, -np.inf)
    for reach in (8.0, 1.5):
        steps = np.unique(np.round(np.linspace(-reach, reach, 17) / record.dt).astype(int))
        tries = np.unique(np.clip(onset + steps, within.start, within.stop - 1))
        tries = tries[np.isneginf(found[tries])]
        if not len(tries):
            continue
        if road is not None:
            found[tries] = road.at(tries.tolist())
        else:
            errors = np.stack([hypothesis.errors(z[None], int(t), coarse=True)[0] for t in tries])
            found[tries] = white.log_likelihood(errors)
        onset = int(np.argmax(found))
    return onset, found


@dataclass(frozen=True, eq=False)
class _Road:
    """Log joint densities with the road grade integrated out, as functions of the common onset of all effects.

    The grade is zero before the onset, which saves the prior cost of its coefficients there.
    """

    slope: GradeMarginal
    full: FloatArray
    along: FloatArray

    @classmethod
    def of(cls, white: WhiteningFilter, hypothesis: Hypothesis, z: FloatArray) -> _Road:
        full = white(hypothesis.errors(z[None], coarse=True)[0])[..., 0]
        silent = white(
            hypothesis.record.measured.mean(-1, keepdims=True) - hypothesis.baseline_rollouts(z[None], coarse=True)[0]
        )[..., 0]
        along = onset_profile(-0.5 * (silent**2).sum(0), -0.5 * (full**2).sum(0))
        return cls(grade_marginal(white, hypothesis, None, coarse=True), full, along)

    def at(self, rows: Sequence[int]) -> FloatArray:
        return self.along[list(rows)] + self.slope.from_rows(self.full, rows)

    def best(self, within: slice) -> tuple[int, float]:
        """Best row, and its gain over an onset at the first row."""
        step = (within.stop - 1 - within.start) / (_PLACES - 1)
        tries = np.linspace(within.start, within.stop - 1, _PLACES).astype(int)
        found: dict[int, float] = {}
        for _ in range(3):
            found |= dict(zip(tries.tolist(), self.at(tries.tolist()).tolist(), strict=True))
            best = max(found, key=lambda row: found[row])
            shifts = np.linspace(-1, 1, 9)[1:-1] * step
            tries = np.unique(np.clip(best + shifts, within.start, within.stop - 1).astype(int))
            step /= 4
        return best, found[best] - float(self.at([0])[0])


def onset_evidence(found: FloatArray, dt: float) -> float:
    """Cost of the unknown onset [nats]: mean likelihood under a uniform prior relative to the best row."""
    tried = np.flatnonzero(np.isfinite(found))
    if len(tried) < 2:
        return -float(np.log(len(found)))
    best = found[tried].max()
    # the likelihood is interpolated linearly between the rows tried
    rows = np.arange(tried[0], tried[-1] + 1)
    inside = np.interp(rows, tried, np.exp(found[tried] - best))
    return float(np.log(max(inside.sum(), 1.0) / len(found)))
