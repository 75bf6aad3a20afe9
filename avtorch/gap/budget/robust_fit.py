"""Least squares that no single block decides: fits of a model to all blocks, or to all but those of one fold.

The noise of a block has a size of its own. With an inverse-gamma prior on it, integrated out, a block's white
residuals of squared sum S cost `(nu + n) / 2 log(1 + S / nu)` nats, Student's law for a block: where something else
goes on for a while (another driver, a kerb), the block says less instead of everything.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Generic

import numpy as np
from typing_extensions import TypeVar

from avtorch.arrays import FloatArray, IntArray
from avtorch.gap.budget.effect_model import LATENESS, EffectModel
from avtorch.gap.budget.fitted_model import FittedModel
from avtorch.gap.budget.held_out_evidence import Evidence, agreement
from avtorch.gap.budget.noise_whitening import NoiseWhitening

_PRIOR_SHARE = 0.2  # of a block's values, that the prior of its noise's size counts as
_STEP = 1e-3  # of the differences
_DAMPING = (1e-3, 0.3, 10.0, 300.0)
_CLOSE = (1e-3, 1.0)  # where the place is known nearly
_LONGEST = 1.0  # step of a coordinate [prior SD], then two and a half of it
_STOP_NATS = 0.05
_MOVED, _KEPT = 0.25, 4  # prior SD, by which a lateness or a sensor has moved; places at which slopes are kept

M = TypeVar("M", bound=FittedModel, default=EffectModel)


@dataclass(frozen=True, eq=False)
class Fit(Generic[M]):
    """A model at its best `z` (size,): it costs `nats` with the prior, `block_nats` (block,) without."""

    model: M
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
    """A model fitted without each fold in turn: `nats` (block,) of the blocks held out, `z` (fold, size).

    `white` (channel, counted): white residuals of the blocks held out.
    """

    nats: FloatArray
    z: FloatArray
    white: FloatArray

    @property
    def prior(self) -> float:
        """What the coordinates cost by their prior [nats], mean of the folds: a value that no car has pays for it.

        Without coordinates nothing.
        """
        return 0.5 * float((self.z**2).sum(-1).mean()) if self.z.size else 0.0


@dataclass(frozen=True, eq=False)
class RobustFit:
    """Fits under one noise; `fold` (block,) is the fold that each block belongs to, folds of neighbours differ."""

    whitening: NoiseWhitening
    folds: int = 6
    fold: IntArray = field(init=False)
    prior: FloatArray = field(init=False)
    half: FloatArray = field(init=False)
    _kept: dict[Any, list[tuple[FloatArray, FloatArray]]] = field(init=False, default_factory=dict, repr=False)

    def __post_init__(self) -> None:
        n = self.whitening.lengths * len(self.whitening.taps) * self.whitening.share
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

    def white(self, model: FittedModel, z: FloatArray) -> FloatArray:
        """White residuals (..., channel, counted) at `z` (..., size)."""
        record = model.record
        response = model.simulate(z)
        return self.whitening(record.measured - np.broadcast_to(response, (*z.shape[:-1], *response.shape[-2:])))

    def fit(self, model: M, starts: FloatArray, *, iterations: int = 8) -> Fit[M]:
        """Gauss-Newton, from the best of `starts` (start, size)."""
        everything = np.ones(self.whitening.blocks)
        white = self.white(model, starts)
        cost = self._cost(white, starts, everything)
        best = int(np.argmin(cost))
        z, now, at = starts[best], float(cost[best]), white[best]
        for _ in range(iterations):
            slope = self.slope(model, z, at)
            curvature = self._curvature_by_block(slope)
            steps = np.concatenate([self._steps(model, z, at, slope, curvature, everything), model.traded(z)])
            white = self.white(model, steps)
            cost = self._cost(white, steps, everything)
            best = int(np.argmin(cost))
            gain = now - float(cost[best])
            if gain > 0:
                z, now, at = steps[best], float(cost[best]), white[best]
            if gain < _STOP_NATS:
                break
        return Fit(model, z, now, self.nats(at))

    def slope(self, model: FittedModel, z: FloatArray, white: FloatArray) -> FloatArray:
        """Derivatives (size, channel, counted) of the white response at `z`, where the white residuals are `white`."""
        # at the upper limit of a coordinate nothing lies ahead
        step = np.where(z + _STEP > model.high, -_STEP, _STEP)
        out, moved = np.empty((len(z), *white.shape)), z + np.diag(step)
        none = np.zeros(len(z), dtype=bool)
        along, behind = (model.along, model.behind) if isinstance(model, EffectModel) else (none, none)
        for some in (~behind, behind & ~along):  # the second leave the actuator as it is
            if some.any():
                out[some] = (white - self.white(model, moved[some])) / step[some, None, None]
        if isinstance(model, EffectModel) and along.any():
            out[along] = self._along(model, z)
        return out

    def _along(self, model: EffectModel, z: FloatArray) -> FloatArray:
        """`slope` (road coordinate, channel, counted) in coordinates in which the response is linear.

        A road of some thirty coefficients would cost as many simulations at every step of a fit. Their slopes change
        with what reads the force alone, and little with that, so they are kept until it has moved.
        """
        lean = model.of_the_road()
        at, own = lean.coordinates(model.named(z)), lean.along
        at[own] = 0.0
        read = at[lean.behind & ~own]
        kept = self._kept.setdefault((lean.names, tuple(sorted(lean.onsets.items()))), [])
        for there, slopes in kept:
            if np.abs(there - read).max(initial=0.0) <= _MOVED:
                return slopes
        change = lean.simulate(at + np.eye(len(at))[own]) - lean.simulate(at)
        kept.insert(0, (read, self.whitening(change)))
        del kept[_KEPT:]
        return kept[0][1]

    def forget(self) -> None:
        """Let go of the slopes that are kept: those of the next fit are its own."""
        self._kept.clear()

    def errors(self, fit: Fit[M]) -> FloatArray:
        """Standard errors (size,) of the coordinates by how much the blocks disagree (Liang and Zeger's sandwich)."""
        white = self.white(fit.model, fit.z)
        slope = self.slope(fit.model, fit.z, white)
        weighed, curvature = self._curvature(slope, white, np.ones(self.whitening.blocks))
        scores = self.whitening.by_block(weighed * white)
        blocks, inverse = scores.shape[-1], np.linalg.inv(curvature)
        covariance = inverse @ (scores @ scores.T) @ inverse * blocks / max(blocks - len(fit.z), 1)
        return np.sqrt(np.diag(covariance))

    def _curvature(self, slope: FloatArray, white: FloatArray, of_blocks: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Weighed slopes (size, channel, counted), and the curvature (size, size) of the cost, prior included."""
        weighed = slope * self.weights(white, of_blocks)
        size = len(slope)
        return weighed, weighed.reshape(size, -1) @ slope.reshape(size, -1).T + np.eye(size)

    def _curvature_by_block(self, slope: FloatArray) -> FloatArray:
        """Products (block, size, size) of the slopes, of which a curvature is a weighed sum whatever is held out."""
        size, ends = len(slope), np.append(self.whitening.first, slope.shape[-1])
        out = np.empty((self.whitening.blocks, size, size))
        for k in range(len(out)):
            own = slope[..., ends[k] : ends[k + 1]].reshape(size, -1)
            np.matmul(own, own.T, out=out[k])
        return out

    def hold_out(self, fit: Fit[M], *, iterations: int = 2) -> HeldOut:
        """Each fold held out, all folds at once.

        The folds' best places lie close to the fit, so its slopes serve all of them; what a step gains is the cost
        itself.
        """
        model, count = fit.model, int(self.fold.max()) + 1
        kept = (self.fold != np.arange(count)[:, None]).astype(float)
        z = np.tile(fit.z, (count, 1))
        here = self.white(model, fit.z)
        slope = self.slope(model, fit.z, here)
        curvature = self._curvature_by_block(slope)
        white = np.tile(here, (count, 1, 1))
        for _ in range(iterations):
            each = [self._steps(model, z[k], white[k], slope, curvature, kept[k], _CLOSE) for k in range(count)]
            most = max(len(x) for x in each)
            steps = np.stack([np.concatenate([x, *[x[:1]] * (most - len(x))]) for x in each])
            tried = self.white(model, steps.reshape(-1, model.size)).reshape(count, most, *here.shape)
            steps, tried = np.concatenate([z[:, None], steps], 1), np.concatenate([white[:, None], tried], 1)
            best = self._cost(tried, steps, kept[:, None]).argmin(1)
            z, white = steps[np.arange(count), best], tried[np.arange(count), best]
        fold = self.whitening.spread(self.fold.astype(float)).astype(int)
        own = white[fold, :, np.arange(white.shape[-1])].T
        return HeldOut(self.nats(own), z, own)

    def spread_out(self, fit: Fit[M], held: HeldOut) -> FloatArray:
        """The places (fold, size) of `held`, of folds that found nothing better than `fit` one step of least squares.

        Where responses are interpolated between rows the likelihood has creases, and a fit that rests on one may stay
        there whatever is held out: its parameters would have intervals of no width.
        """
        z, still = held.z.copy(), (held.z == fit.z).all(1)
        if not still.any():
            return z
        white = self.white(fit.model, fit.z)
        slope = self.slope(fit.model, fit.z, white)

        def step(of_blocks: FloatArray) -> FloatArray:
            weighed, curvature = self._curvature(slope, white, of_blocks)
            downhill = weighed.reshape(len(fit.z), -1) @ white.ravel() - fit.z
            return np.asarray(np.linalg.solve(curvature, downhill), float)

        whole = step(np.ones(self.whitening.blocks))
        for k in np.nonzero(still)[0]:
            moved = step((self.fold != k).astype(float)) - whole
            moved *= min(1.0, _LONGEST / float(np.abs(moved).max(initial=1e-12)))
            z[k] = np.clip(fit.z + moved, fit.model.low, fit.model.high)
        return z

    def evidence(self, before: HeldOut, after: HeldOut) -> Evidence:
        """What held-out blocks say for `after`, a model with more in it than `before`: is its change there at all?"""
        change = before.white - after.white
        return self._evidence(before, after, self._by_block(before, change * before.white), change)

    def preference(self, one: HeldOut, other: HeldOut) -> Evidence:
        """What held-out blocks say for `other` against `one`, neither of which is part of the other."""
        change = one.white - other.white
        return self._evidence(one, other, self._by_block(one, 0.5 * (one.white**2 - other.white**2)), change)

    def on_top(self, before: HeldOut, best: HeldOut, other: HeldOut) -> float:
        """Nats that `other`, another model than `best` after `before`, would add to it by what the two do not share."""
        one, two = before.white - best.white, before.white - other.white
        weight = self.whitening.spread(self._weight(best))

        def product(x: FloatArray, y: FloatArray) -> float:
            return float((weight * x * y).sum())

        apart = two - product(one, two) / max(product(one, one), 1e-12) * one
        return 0.5 * max(product(apart, best.white), 0.0) ** 2 / max(product(apart, apart), 1e-12)

    def _evidence(self, before: HeldOut, after: HeldOut, score: FloatArray, change: FloatArray) -> Evidence:
        errors, freedom = agreement(score, self._by_block(before, change**2))
        return Evidence(float((before.nats - after.nats).sum()) + before.prior - after.prior, errors, freedom)

    def _by_block(self, held: HeldOut, products: FloatArray) -> FloatArray:
        """Sums (block,) of `products` (channel, counted), weighed by Student's law."""
        return self._weight(held) * self.whitening.by_block(products)

    def _weight(self, held: HeldOut) -> FloatArray:
        return 2 * self.half / (self.prior + self.whitening.by_block(held.white**2))

    def weights(self, white: FloatArray, of_blocks: FloatArray) -> FloatArray:
        """Of rows (counted,) in a step of least squares: blocks that fit badly weigh less, by Student's law."""
        return self.whitening.spread(self._weights_of_blocks(white, of_blocks))

    def _weights_of_blocks(self, white: FloatArray, of_blocks: FloatArray) -> FloatArray:
        return of_blocks * 2 * self.half / (self.prior + self.whitening.by_block(white**2))

    def _cost(self, white: FloatArray, z: FloatArray, weights: FloatArray) -> FloatArray:
        return (self.nats(white) * weights).sum(-1) + 0.5 * (z**2).sum(-1)

    def _steps(
        self,
        model: FittedModel,
        z: FloatArray,
        white: FloatArray,
        slope: FloatArray,
        by_block: FloatArray,
        of_blocks: FloatArray,
        dampings: Sequence[float] = _DAMPING,
    ) -> FloatArray:
        """Places (step, size) to try from `z`, more and less damped; `by_block` as `_curvature_by_block` has it.

        And one that leaves the lateness alone: where neither channel is late the likelihood has a crease, and slopes on
        one side of it say nothing of the other.
        """
        weights = self._weights_of_blocks(white, of_blocks)
        curvature = np.tensordot(weights, by_block, 1) + np.eye(model.size)
        downhill = slope.reshape(model.size, -1) @ (self.whitening.spread(weights) * white).ravel() - z
        every = np.ones(model.size, bool)
        tries = [(damping, every) for damping in dampings]
        if LATENESS in model.index:
            others = every.copy()
            others[model.index[LATENESS]] = False
            tries.append((dampings[0], others))
        out = []
        for damping, free in tries:
            step, inner = np.zeros(model.size), curvature[np.ix_(free, free)]
            step[free] = np.linalg.solve(inner + damping * np.diag(np.diag(inner)), downhill[free])
            longest = float(np.abs(step).max(initial=1e-12))
            for cap in (_LONGEST, 2.5 * _LONGEST) if longest > _LONGEST else (_LONGEST,):
                out.append(np.clip(z + step * min(1.0, cap / longest), model.low, model.high))
        return np.array(out)
