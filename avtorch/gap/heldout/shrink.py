"""How far the gap shrinks: before, after, floor and placebo on blocks that chose neither effect nor parameters.

The floor is what the verdict leaves where all drives fit its parameters, and what it takes to know them no better than
that; or what a flexible regression leaves, where it is below by more than chance. Intervals are of blocks drawn anew,
with replacement, wider by what few blocks tell too little of their own spread (Student's t).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.stats import norm as normal
from scipy.stats import t as student

from avtorch.gap.answer.quantity import Quantity
from avtorch.gap.answer.shrinkage import Closed, Shrinkage
from avtorch.gap.heldout.held_out import HeldOut
from avtorch.gap.heldout.rollout_errors import USUAL

Float = NDArray[np.float64]

DENSITY = "log_predictive_density"
_DRAWS = 2000
_TELLS = 1.1  # before over floor, for less of which there is nothing to close
_TELLS_NATS = 5.0  # likewise of densities, over all blocks


def shrinkage(held: HeldOut) -> Shrinkage:
    """From what blocks held out say of a verdict."""
    sums, rows, kinds = held.sums, held.rows, held.measures
    rng = np.random.default_rng(0)
    blocks = len(rows)
    drawn = rng.multinomial(blocks, np.full(blocks, 1 / blocks), size=_DRAWS).astype(float)
    weights = np.concatenate([np.ones((1, blocks)), drawn])

    by_metric, placebos, ceiling = {}, {}, {}
    for k, measure in enumerate(kinds):
        square = {name: s.squares[k] for name, s in sums.items()}
        floor = _floor(square["fitted"] + square["owed"], square["flexible"], below=True)
        total = {name: np.sqrt(weights @ x / (weights @ rows)) for name, x in square.items()}
        total["floor"] = np.sqrt(np.maximum(weights @ floor, 0.0) / (weights @ rows))
        tells = total["before"][0] > _TELLS * total["floor"][0]
        by_metric[measure.name] = _closed(total, tells, blocks)
        placebos[measure.name] = _placebo(total, tells, blocks)
        ceiling[measure.name] = float(total["ceiling"][0])
    nats = {name: s.nats for name, s in sums.items()}
    best = _floor(nats["fitted"] - nats["owed"], nats["flexible"], below=False)
    total = {name: weights @ x / (weights @ rows) for name, x in nats.items()}
    total["floor"] = weights @ best / (weights @ rows)
    tells = (total["floor"][0] - total["before"][0]) * rows.sum() > _TELLS_NATS
    by_metric[DENSITY] = _closed(total, tells, blocks)
    placebos[DENSITY] = _placebo(total, tells, blocks)
    ceiling[DENSITY] = float(total["ceiling"][0])
    usual = [m.name for m in kinds if m.horizon_s == USUAL[m.witness]]
    shows = {name: by_metric[name].before / max(by_metric[name].floor, 1e-12) for name in usual}
    metric = max(shows, key=lambda name: shows[name])
    if held.by_chance or shows[metric] < _TELLS:
        metric = DENSITY
    return Shrinkage(
        metric=metric,
        by_metric=by_metric,
        placebo_effect=None if held.sham is None else held.sham.name,
        placebo=placebos[metric],
        ceiling=ceiling,
        chosen=held.chosen,
        blocks=blocks,
        by_drives=held.by_drives,
    )


def _floor(model: Float, flexible: Float, *, below: bool) -> Float:
    """(block,): the flexible regression's where it beats the model by more than blocks differ."""
    gain = (model - flexible) if below else (flexible - model)
    if len(gain) > 1 and gain.mean() > 1.645 * gain.std(ddof=1) / np.sqrt(len(gain)):
        return flexible
    return model


def _closed(total: dict[str, Float], tells: bool, blocks: int) -> Closed:
    """From values (draw,), the first of all blocks once."""
    share = None
    if tells:
        share = _share(total["before"] - total["after"], total["before"] - total["floor"], blocks)
    before, after, floor = (float(total[name][0]) for name in ("before", "after", "floor"))
    return Closed(before, after, floor, share)


def _placebo(total: dict[str, Float], tells: bool, blocks: int) -> Quantity | None:
    if not tells or "placebo" not in total:
        return None
    return _share(total["verdict"] - total["placebo"], total["before"] - total["floor"], blocks)


def _share(part: Float, whole: Float, blocks: int) -> Quantity:
    draws = part[1:] / np.where(np.abs(whole[1:]) > 1e-12, whole[1:], np.nan)
    draws = draws[np.isfinite(draws)]
    mean = float(part[0] / whole[0])
    wider = float(student.ppf(0.95, blocks - 1) / normal.ppf(0.95) * np.sqrt(blocks / (blocks - 1)))
    q05, q95 = mean + wider * (np.quantile(draws, (0.05, 0.95)) - mean)
    return Quantity(mean, wider * float(draws.std()), min(float(q05), mean), max(float(q95), mean))
