"""Least squares that no single block decides: fits of a model to all blocks, or to all but those of one fold.

The noise of a block has a size of its own. With an inverse-gamma prior on it, integrated out, a block's white
residuals of squared sum S cost `(nu + n) / 2 log(1 + S / nu)` nats, Student's law for a block: where something else
goes on for a while (another driver, a kerb), the block says less instead of everything.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from avtorch.arrays import FloatArray, IntArray
from avtorch.gap.budget.effect_model import EffectModel
from avtorch.gap.budget.noise_whitening import NoiseWhitening

_PRIOR_SHARE = 0.2  # of a block's rows, that the prior of its noise's size counts as
_STEP = 1e-3  # of the differences
_DAMPING = (1e-3, 0.3, 10.0, 300.0)
_LONGEST = 1.0  # step of a coordinate [prior SD], then two and a half of it
_STOP_NATS = 0.02


@dataclass(frozen=True, eq=False)
class Fit:
    """A model at its best `z` (size,): it costs `nats` with the prior, `block_nats` (block,) without."""

    model: EffectModel
    z: FloatArray
    nats: float
    block_nats: FloatArray

    @property
    def known(self) -> Mapping[str, FloatArray]:
        return self.model.named(self.z)

    @property
    def residuals(self) -> FloatArray:
        """(channel, row) [m/s²]."""
        return self.model.record.measured - self.model.simulate(self.z)


@dataclass(frozen=True, eq=False)
class HeldOut:
    """A model fitted without each fold in turn: `nats` (block,) of the blocks held out, `z` (fold, size)."""

    nats: FloatArray
    z: FloatArray


@dataclass(frozen=True, eq=False)
class RobustFit:
    """Fits under one noise; `fold` (block,) is the fold that each block belongs to, folds of neighbours differ."""

    whitening: NoiseWhitening
    folds: int = 6
    fold: IntArray = field(init=False)
    prior: FloatArray = field(init=False)
    half: FloatArray = field(init=False)

    def __post_init__(self) -> None:
        n = self.whitening.lengths * len(self.whitening.taps)
        object.__setattr__(self, "fold", np.arange(self.whitening.blocks) % min(self.folds, self.whitening.blocks))
        object.__setattr__(self, "prior", _PRIOR_SHARE * n)
        object.__setattr__(self, "half", 0.5 * (1 + _PRIOR_SHARE) * n)

    @property
    def fold_of_row(self) -> IntArray:
        """Fold (row,) whose model did not see the row; -1 where the row is of no block that is scored."""
        record = self.whitening.record
        by_block = np.full(record.blocks, -1)
        by_block[self.whitening.numbers] = self.fold
        return np.where(record.block >= 0, by_block[np.maximum(record.block, 0)], -1)

    def nats(self, white: FloatArray) -> FloatArray:
        """Cost (..., block) of white residuals (..., channel, counted)."""
        return self.half * np.log1p(self.whitening.by_block(white**2) / self.prior)

    def white(self, model: EffectModel, z: FloatArray) -> FloatArray:
        """White residuals (..., channel, counted) at `z` (..., size)."""
        record = model.record
        response = model.simulate(z)
        return self.whitening(record.measured - np.broadcast_to(response, (*z.shape[:-1], *response.shape[-2:])))

    def fit(self, model: EffectModel, starts: FloatArray, *, iterations: int = 8) -> Fit:
        """Gauss and Newton's, from the best of `starts` (start, size)."""
        everything = np.ones((1, self.whitening.blocks))
        white = self.white(model, starts)
        cost = self._cost(white, starts, everything)
        best = int(np.argmin(cost))
        z, now, at = starts[best], float(cost[best]), white[best]
        for _ in range(iterations):
            steps = np.concatenate([self._steps(model, z, at, everything[0]), model.traded(z)])
            white = self.white(model, steps)
            cost = self._cost(white, steps, everything)
            best = int(np.argmin(cost))
            gain = now - float(cost[best])
            if gain > 0:
                z, now, at = steps[best], float(cost[best]), white[best]
            if gain < _STOP_NATS:
                break
        return Fit(model, z, now, self.nats(at))

    def hold_out(self, fit: Fit, *, iterations: int = 2) -> HeldOut:
        """Each fold held out, all folds at once."""
        model, count = fit.model, int(self.fold.max()) + 1
        kept = (self.fold != np.arange(count)[:, None]).astype(float)
        z = np.tile(fit.z, (count, 1))
        for _ in range(iterations):
            around = z[:, None] + np.concatenate([np.zeros((1, model.size)), _STEP * np.eye(model.size)])
            white = self.white(model, around.reshape(-1, model.size)).reshape(
                *around.shape[:2], len(self.whitening.sd), -1
            )
            steps = np.stack(
                [
                    self._steps(model, z[k], white[k, 0], kept[k], (white[k, 0] - white[k, 1:]) / _STEP)
                    for k in range(count)
                ]
            )
            steps = np.concatenate([z[:, None], steps], 1)
            shape = steps.shape[:2]
            tried = self.white(model, steps.reshape(-1, model.size)).reshape(*shape, len(self.whitening.sd), -1)
            cost = self._cost(tried, steps, kept[:, None])
            z = np.take_along_axis(steps, cost.argmin(1)[:, None, None], 1)[:, 0]
        nats = self.nats(self.white(model, z))
        return HeldOut(nats[self.fold, np.arange(self.whitening.blocks)], z)

    def _cost(self, white: FloatArray, z: FloatArray, weights: FloatArray) -> FloatArray:
        return (self.nats(white) * weights).sum(-1) + 0.5 * (z**2).sum(-1)

    def _steps(
        self,
        model: EffectModel,
        z: FloatArray,
        white: FloatArray,
        weights: FloatArray,
        slope: FloatArray | None = None,
    ) -> FloatArray:
        """Places (step, size) to try from `z`, more and less damped."""
        if slope is None:
            slope = (white - self.white(model, z + _STEP * np.eye(model.size))) / _STEP
        sums = self.whitening.by_block(white**2)
        # of the log of Student's law: blocks that fit badly weigh less
        by_row = self.whitening.spread(weights * 2 * self.half / (self.prior + sums))
        weighed = (slope * by_row).reshape(model.size, -1)
        curvature = weighed @ slope.reshape(model.size, -1).T + np.eye(model.size)
        downhill = weighed @ white.ravel() - z
        out = []
        for damping in _DAMPING:
            step = np.linalg.solve(curvature + damping * np.diag(np.diag(curvature)), downhill)
            longest = float(np.abs(step).max(initial=1e-12))
            for cap in (_LONGEST, 2.5 * _LONGEST) if longest > _LONGEST else (_LONGEST,):
                out.append(np.clip(z + step * min(1.0, cap / longest), model.low, model.high))
        while len(out) < 2 * len(_DAMPING):  # as many for each fold
            out.append(out[0])
        return np.array(out)
