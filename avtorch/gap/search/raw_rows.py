"""What a find leaves over at the log's own rows, one by one, as causes need it that chance decides row by row."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from avtorch.gap.likelihood.candidate import Candidate
from avtorch.gap.likelihood.record import Record
from avtorch.gap.likelihood.whitener import Whitener
from avtorch.gap.search.found import Found

Float = NDArray[np.float64]


def raw_errors(raw: Record, of: Found) -> Float:
    """Errors (witness, counted, 1) of a find's rollout over `raw`, the same drives in rows of their own."""
    candidate = Candidate(raw, of.candidate.effects, of.candidate.baseline)
    errors = candidate.errors(of.z[None])[0]
    if of.onset is not None:
        onset, group = raw_row(raw, of, of.onset), of.candidate.record.group
        if raw.accel is not None:
            # rows of the group in which it sets in would pass for glitches
            silent = raw.measured[0] - candidate.baseline_rollouts(of.z[None])[0, 0]
            near = slice(max(onset - group, 0), onset + group)
            before = np.cumsum((silent**2 - errors[0] ** 2)[near, 0])
            onset = near.start + int(np.concatenate([[0.0], before]).argmin())
        errors = candidate.errors(of.z[None], onset)[0]
    if of.profile is not None:
        errors = errors - candidate.grade_response(of.profile)
    return errors


def raw_row(raw: Record, of: Found, row: int) -> int:
    """Where a counted row of the find's record lies among those of single rows."""
    return int(np.searchsorted(raw.source, of.candidate.record.source[row] * of.candidate.record.group))


def raw_white(raw: Record, of: Found) -> Whitener:
    """Of errors at the log's own rows."""
    return Whitener(raw, of.noise.noise, tuple((raw_row(raw, of, row), n) for row, n in of.white.until))
