"""How far the gap shrinks with all parts of a budget, in the terms of `avtorch.gap.crossval.gap_closed`."""

from __future__ import annotations

import numpy as np

from avtorch.arrays import FloatArray
from avtorch.gap.answer.shrinkage import MetricShrinkage, Shrinkage
from avtorch.gap.budget.flexible_regression import predicted_residuals
from avtorch.gap.budget.rollout_energy import calm_blocks, counted_rows, held_out_residuals, horizon, rollout_squares
from avtorch.gap.budget.selection_step import Selection
from avtorch.gap.quantity import Quantity

_DRAWS = 2000
_LEAST = 1.1  # ratio of before to floor below which there is no gap to close


def shrinkage_of(selection: Selection, *, seed: int = 0) -> Shrinkage:
    """Errors of held-out rollouts before and after all parts, and with a flexible regression on the bare baseline.

    Blocks are held out of the fits, not of the selection: `chosen` is None.
    """
    first, last = selection.steps[0], selection.last
    before, after = (held_out_residuals(selection, step) for step in (first, last))
    fitting = selection.fitting
    floor = after - predicted_residuals(fitting, last.fit, after)
    ceiling = before - predicted_residuals(fitting, first.fit, before)
    squares = np.stack([rollout_squares(selection, x) for x in (before, after, floor, ceiling)])
    calm = calm_blocks(selection)
    rows, blocks = counted_rows(selection)[calm], len(calm)
    draws = np.random.default_rng(seed).multinomial(blocks, np.ones(blocks) / blocks, _DRAWS)
    weights = np.concatenate([np.ones((1, blocks)), draws]) * rows
    means = np.einsum("db,mcb->mcd", weights, squares[..., calm]) / weights.sum(-1)
    roots = np.sqrt(means)  # (model, channel, draw)
    names = [f"rollout_rmse_{c}" for c in fitting.whitening.record.channels]
    span = horizon(fitting.whitening.record)
    by_metric = {name: _closed(roots[0, c], roots[1, c], roots[2, c], horizon_s=span) for c, name in enumerate(names)}
    return Shrinkage(
        metric=max(names, key=lambda name: by_metric[name].before / max(by_metric[name].floor, 1e-12)),
        by_metric=by_metric,
        placebo_effect=None,
        placebo=None,
        ceiling={name: float(roots[3, c, 0]) for c, name in enumerate(names)},
        chosen=None,
        blocks=blocks,
    )


def _closed(before: FloatArray, after: FloatArray, floor: FloatArray, *, horizon_s: float) -> MetricShrinkage:
    """Of errors (draw,), the first of them over all blocks."""
    floor = np.minimum(floor, after)
    closed = None
    if before[0] > _LEAST * floor[0]:
        share = (before - after) / np.maximum(before - floor, 1e-12)
        q05, q95 = np.quantile(share[1:], (0.05, 0.95))
        mean = float(share[0])
        closed = Quantity(mean, float(share[1:].std()), min(float(q05), mean), max(float(q95), mean))
    return MetricShrinkage(float(before[0]), float(after[0]), float(floor[0]), closed, horizon_s)
