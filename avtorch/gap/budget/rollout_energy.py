"""Errors of rollouts over 10 s, every block's by a model that was fitted without it.

Speed is rolled out from its measured value at the beginning of each 10 s of rows that count. The tenth of the blocks
that the selected model predicts worst is left out: a local disturbance such as a kerb does not decide a budget.
"""

from __future__ import annotations

import numpy as np

from avtorch.arrays import FloatArray, IntArray
from avtorch.gap.answer.budget import BEGIN_S, HORIZON_S
from avtorch.gap.budget.analysis_record import AnalysisRecord
from avtorch.gap.budget.selection_step import Selection, Step


def horizon(record: AnalysisRecord) -> float:
    """Length of the rollouts [s]: `HORIZON_S`, or the longest run of rows that count where that is shorter."""
    longest = max(run.stop - run.start for run in record.runs()) * record.dt
    return min(HORIZON_S, longest)


def held_out_residuals(selection: Selection, step: Step) -> FloatArray:
    """(channel, row): each block's by the fit that was made without it."""
    record = selection.fitting.whitening.record
    response = step.fit.model.simulate(step.held.z)  # (fold, channel, row)
    which = np.maximum(selection.fitting.fold_of_row, 0)
    return record.measured - response[which, :, np.arange(record.rows)].T


def rollout_squares(selection: Selection, residuals: FloatArray) -> FloatArray:
    """Mean squared errors (channel, block) of rollouts of `residuals` (channel, row), begun anew every 10 s."""
    record = selection.fitting.whitening.record
    out = np.zeros((len(record.channels), record.blocks))
    window, begin = round(HORIZON_S / record.dt), max(1, round(BEGIN_S / record.dt))
    errors = residuals.copy()
    if record.has_speed:
        drift = np.zeros(record.rows)
        for run in record.runs():
            for start in range(run.start, run.stop, window):
                rows = slice(start, min(start + window, run.stop))
                gained = np.cumsum(residuals[0, rows]) * record.dt
                drift[rows] = gained - gained[:begin].mean()
        errors[0] = drift
    for c in range(len(out)):
        squares = np.bincount(record.block[record.counts], errors[c, record.counts] ** 2, record.blocks)
        out[c] = squares / np.maximum(np.bincount(record.block[record.counts], minlength=record.blocks), 1)
    return out


def calm_blocks(selection: Selection) -> IntArray:
    """Blocks that are scored, but the tenth that the selected model predicts worst: a kerb does not decide a budget."""
    squares = rollout_squares(selection, held_out_residuals(selection, selection.last))
    scored = selection.fitting.whitening.numbers
    worst = (squares / (np.median(squares[:, scored], -1, keepdims=True) + 1e-12)).max(0)[scored]
    return np.sort(scored[np.argsort(worst)[: max(1, round(0.9 * len(worst)))]])


def counted_rows(selection: Selection) -> FloatArray:
    """Rows (block,) that count."""
    record = selection.fitting.whitening.record
    return np.bincount(record.block[record.counts], minlength=record.blocks).astype(float)


def relative_energy(selection: Selection, step: Step) -> float:
    """Mean squared error of held-out rollouts, in units of what the bare baseline's are, mean of the channels."""
    errors = rollout_squares(selection, held_out_residuals(selection, step))
    bare = rollout_squares(selection, held_out_residuals(selection, selection.steps[0]))
    return float((_typical(selection, errors) / _typical(selection, bare)).mean())


def _typical(selection: Selection, squares: FloatArray) -> FloatArray:
    """Mean (channel,) over the calm blocks of `squares` (channel, block)."""
    calm = calm_blocks(selection)
    return squares[:, calm].mean(-1) + 1e-12
