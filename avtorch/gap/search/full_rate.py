"""Residuals of a fitted model at the log's own rate, without averaging of rows, for random effects on single rows."""

from __future__ import annotations

import numpy as np

from avtorch.arrays import FloatArray
from avtorch.gap.drive_record import Record
from avtorch.gap.likelihood.hypothesis import Hypothesis
from avtorch.gap.likelihood.whitening_filter import WhiteningFilter
from avtorch.gap.search.fitted_model import FittedModel


def full_rate_errors(raw: Record, of: FittedModel) -> FloatArray:
    """Errors (channel, counted, 1) of a model's rollout over `raw`, the same drives without averaging of rows."""
    hypothesis = Hypothesis(raw, of.hypothesis.effects, of.hypothesis.baseline)
    errors = hypothesis.errors(of.z[None])[0]
    if of.onset is not None:
        onset, group = full_rate_row(raw, of, of.onset), of.hypothesis.record.group
        if raw.accel is not None:
            # otherwise the first rows of the group at the onset would resemble outliers
            silent = raw.measured[0] - hypothesis.baseline_rollouts(of.z[None])[0, 0]
            near = slice(max(onset - group, 0), onset + group)
            before = np.cumsum((silent**2 - errors[0] ** 2)[near, 0])
            onset = near.start + int(np.concatenate([[0.0], before]).argmin())
        errors = hypothesis.errors(of.z[None], onset)[0]
    if of.profile is not None:
        errors = errors - hypothesis.grade_response(of.profile)
    return errors


def full_rate_row(raw: Record, of: FittedModel, row: int) -> int:
    """Index of a counted row of the model's record among the single rows."""
    return int(np.searchsorted(raw.source, of.hypothesis.record.source[row] * of.hypothesis.record.group))


def full_rate_filter(raw: Record, of: FittedModel) -> WhiteningFilter:
    """The whitening filter for errors at the log's own rate."""
    return WhiteningFilter(raw, of.noise.noise, tuple((full_rate_row(raw, of, row), n) for row, n in of.white.until))
