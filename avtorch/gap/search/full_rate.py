"""What a find leaves over at the log's own rows, one by one, as causes need it that chance decides row by row."""

from __future__ import annotations

import numpy as np

from avtorch.arrays import FloatArray
from avtorch.gap.likelihood.hypothesis import Hypothesis
from avtorch.gap.likelihood.record import Record
from avtorch.gap.likelihood.whitening_filter import WhiteningFilter
from avtorch.gap.search.fitted_model import FittedModel


def full_rate_errors(raw: Record, of: FittedModel) -> FloatArray:
    """Errors (channel, counted, 1) of a find's rollout over `raw`, the same drives in rows of their own."""
    hypothesis = Hypothesis(raw, of.hypothesis.effects, of.hypothesis.baseline)
    errors = hypothesis.errors(of.z[None])[0]
    if of.onset is not None:
        onset, group = full_rate_row(raw, of, of.onset), of.hypothesis.record.group
        if raw.accel is not None:
            # rows of the group in which it sets in would pass for glitches
            silent = raw.measured[0] - hypothesis.baseline_rollouts(of.z[None])[0, 0]
            near = slice(max(onset - group, 0), onset + group)
            before = np.cumsum((silent**2 - errors[0] ** 2)[near, 0])
            onset = near.start + int(np.concatenate([[0.0], before]).argmin())
        errors = hypothesis.errors(of.z[None], onset)[0]
    if of.profile is not None:
        errors = errors - hypothesis.grade_response(of.profile)
    return errors


def full_rate_row(raw: Record, of: FittedModel, row: int) -> int:
    """Where a counted row of the find's record lies among those of single rows."""
    return int(np.searchsorted(raw.source, of.hypothesis.record.source[row] * of.hypothesis.record.group))


def full_rate_filter(raw: Record, of: FittedModel) -> WhiteningFilter:
    """Of errors at the log's own rows."""
    return WhiteningFilter(raw, of.noise.noise, tuple((full_rate_row(raw, of, row), n) for row, n in of.white.until))
