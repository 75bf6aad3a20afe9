"""How far the gap shrinks: before, after, floor and placebo on held-out blocks.

The floor is the verdict's residual noise, with the uncertainty of its parameters (`noise_floor.py`); where a flexible
regression leaves significantly less, the floor is what that leaves. Intervals combine draws of the floor over the
parameters, the share of the regression's gain, and bootstrapped blocks; they are widened by Student's t because few
blocks estimate their own spread poorly.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import norm as normal
from scipy.stats import t as student

from avtorch.arrays import FloatArray
from avtorch.gap.answer.shrinkage import MetricShrinkage, Shrinkage
from avtorch.gap.crossval.cross_validate import CrossValidation
from avtorch.gap.crossval.noise_floor import drawn, expected
from avtorch.gap.quantity import Quantity
from avtorch.gap.rollout_errors import HORIZON_S, reached

DENSITY = "log_predictive_density"
_DRAWS = 2000
_LEAST_RATIO = 1.1  # ratio of before to floor below which there is no gap to close
_MATERIAL = 0.1  # share of the gap (in squares) that a flexible regression must close to replace the floor
_LEAST_NATS = 5.0  # the same threshold for densities [nats], over all blocks


def gap_closed(held: CrossValidation) -> Shrinkage:
    """The shrinkage of the gap from cross-validation scores of a verdict."""
    sums, kinds, blocks = held.sums, held.metrics, len(held.rows)
    rng = np.random.default_rng(0)
    again = rng.multinomial(blocks, np.full(blocks, 1 / blocks), size=_DRAWS).astype(float)
    z = rng.standard_normal((_DRAWS, held.floor.axes))
    totals: dict[str, _MetricSums] = {}
    for k, kind in enumerate(kinds):
        square = {name: s.squares[k] for name, s in sums.items()}
        form = held.floor.squares[k]
        floors = _floors(square, expected(form), drawn(form, z), rng, better=-1)
        totals[kind.name] = _MetricSums(square, floors, held.rows, again, better=-1)
    nats = {name: s.nats for name, s in sums.items()}
    form = held.floor.nats
    best = nats["fitted"] + form[:, 0, 0]
    floors = _floors(nats, best - expected(form), best - drawn(form, z), rng, better=1)
    totals[DENSITY] = _MetricSums(nats, floors, held.rows, again, better=1)

    spans = {m.name: reached(m, held.record) for m in kinds}
    by_metric = {name: replace(one.closed, horizon_s=spans.get(name)) for name, one in totals.items()}
    usual = [m.name for m in kinds if m.horizon_s == HORIZON_S]
    shows = {name: by_metric[name].before / max(by_metric[name].floor, 1e-12) for name in usual}
    metric = max(shows, key=lambda name: shows[name])
    if held.by_chance or shows[metric] < _LEAST_RATIO:
        metric = DENSITY
    return Shrinkage(
        metric=metric,
        by_metric=by_metric,
        placebo_effect=None if held.placebo_effect is None else held.placebo_effect.name,
        placebo=totals[metric].placebo,
        ceiling={m.name: totals[m.name].all_in("ceiling") for m in kinds}
        | {DENSITY: totals[DENSITY].all_in("ceiling")},
        chosen=held.chosen,
        blocks=blocks,
        by_drives=held.by_drives,
    )


def _floors(
    sums: Mapping[str, FloatArray], mean: FloatArray, draws: FloatArray, rng: np.random.Generator, *, better: int
) -> FloatArray:
    """Floors (1 + draw, block), the mean first.

    The mean is the flexible regression's where it beats the model significantly over blocks and by a tenth of the gap
    or more: where a controller feeds noise back into its commands, a regression predicts a little of the noise itself.
    What share of the regression's gain a model could reach is unknown, so the draws take a uniform share.
    """
    gain = better * (sums["flexible"] - mean)
    count = len(gain)
    if gain.sum() > 0:
        draws = draws + better * rng.random((len(draws), 1)) * gain
    sure = count > 1 and gain.mean() > student.ppf(0.95, count - 1) * gain.std(ddof=1) / np.sqrt(count)
    if sure and gain.sum() > _MATERIAL * (better * (mean - sums["before"])).sum():
        mean = sums["flexible"]
    return np.concatenate([mean[None], draws])


@dataclass(frozen=True, eq=False)
class _MetricSums:
    """Scores by one measure: sums by name (block,), `floors` (1 + draw, block), rows (block,), and bootstrap counts
    `again` (draw, block). `better` -1: sums are of squares, reported as root mean squares."""

    sums: Mapping[str, FloatArray]
    floors: FloatArray
    rows: FloatArray
    again: FloatArray
    better: int

    def all_in(self, name: str) -> float:
        """Mean over all blocks, without the bootstrap."""
        return float(self._mean(self.sums[name], np.ones(len(self.rows))))

    @property
    def closed(self) -> MetricShrinkage:
        before, after = self.all_in("before"), self.all_in("after")
        floor = float(self._mean(self.floors[0], np.ones(len(self.rows))))
        return MetricShrinkage(before, after, floor, self._share("before", "after") if self._has_gap else None)

    @property
    def placebo(self) -> Quantity | None:
        return self._share("verdict", "placebo") if self._has_gap and "placebo" in self.sums else None

    @property
    def _has_gap(self) -> bool:
        """Whether there is a gap to close."""
        before, floor = self.all_in("before"), float(self._mean(self.floors[0], np.ones(len(self.rows))))
        if self.better < 0:
            return before > _LEAST_RATIO * floor
        return (floor - before) * self.rows.sum() > _LEAST_NATS

    def _mean(self, sums: FloatArray, weights: FloatArray) -> FloatArray:
        """Mean per row, over blocks (..., block) with weights (..., block)."""
        mean = (weights * sums).sum(-1) / (weights * self.rows).sum(-1)
        return np.sqrt(np.maximum(mean, 0.0)) if self.better < 0 else mean

    def _share(self, one: str, other: str) -> Quantity:
        """Difference between two sums as a share of the reducible gap."""

        def share(weights: FloatArray, floors: FloatArray) -> FloatArray:
            before, a, b = (self._mean(self.sums[name], weights) for name in ("before", one, other))
            whole = before - self._mean(floors, weights)
            return (a - b) / np.where(np.abs(whole) > 1e-12, whole, np.nan)

        blocks = len(self.rows)
        mean = float(share(np.ones(blocks), self.floors[0]))
        wider = float(student.ppf(0.95, blocks - 1) / normal.ppf(0.95) * np.sqrt(blocks / (blocks - 1)))
        away = wider * (share(self.again, self.floors[0]) - mean) + share(np.ones(blocks), self.floors[1:]) - mean
        away = away[np.isfinite(away)]
        q05, q95 = mean + np.quantile(away, (0.05, 0.95))
        return Quantity(mean, float(away.std()), min(float(q05), mean), max(float(q95), mean))
