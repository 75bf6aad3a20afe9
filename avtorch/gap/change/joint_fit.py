"""Fits of a change together with the remainder that both sides share, by all blocks or by those of the other folds.

The remainder is linear in its coefficients. So for each vector `p` of the model the best coefficients follow from sums
over blocks, and Gauss and Newton's steps are taken in both at once. Blocks have noise of their own size (Student's law
for a block, `budget.robust_fit`), so none decides alone.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np

from avtorch.arrays import FloatArray
from avtorch.gap.budget.noise_whitening import NoiseWhitening
from avtorch.gap.budget.robust_fit import RobustFit
from avtorch.gap.change.change_model import AFTER, ChangeModel

_STEP = 1e-3  # of the differences
_DAMPING = (1e-3, 0.3, 10.0)
_LONGEST = 1.5  # step of a coordinate [prior SD]
_NEAR = 0.3  # standard deviations of the plant's priors, around an anchor
_STOP_NATS = 0.05
_SHOWN = 1e-6  # of the largest column's square, that a column counts
_REWEIGHTED = 3  # times that the weights of blocks follow the residuals, in linear fits


@dataclass(frozen=True, eq=False)
class Fit:
    """A model at its best `p` (size,), with the remainder's coefficients `c` (column,); it costs `nats` with priors."""

    model: ChangeModel
    p: FloatArray
    c: FloatArray
    nats: float


@dataclass(frozen=True, eq=False)
class HeldOut:
    """A model fitted without each fold in turn: `nats` (block,) of blocks held out, `p` (fold, size)."""

    nats: FloatArray
    p: FloatArray


@dataclass(frozen=True, eq=False)
class JointFit:
    """Fits under one noise with the columns of one remainder; `ridge`: of their coefficients, a share of all rows.

    `anchor`: coordinates of GLVD without the remainder, by name, near which what both sides share stays: a remainder of
    many columns could else trade a gain of 1 for one of 1.5. Without it, and for effects, the priors are the plant's.
    """

    whitening: NoiseWhitening
    shapes: FloatArray = field(repr=False)
    ridge: float = 1e-3
    anchor: Mapping[str, FloatArray] = field(default_factory=dict)
    robust: RobustFit = field(init=False)
    X: FloatArray = field(init=False, repr=False)
    scale: FloatArray = field(init=False, repr=False)

    def __post_init__(self) -> None:
        white = self.whitening(self.shapes)
        scale = np.sqrt((white**2).mean((1, 2))) + 1e-12
        robust = RobustFit(self.whitening)
        for name, value in (("robust", robust), ("X", white / scale[:, None, None]), ("scale", scale)):
            object.__setattr__(self, name, value)

    @property
    def penalty(self) -> float:
        return self.ridge * self.whitening.lengths.sum() * len(self.whitening.sd)

    @property
    def folds(self) -> int:
        return int(self.robust.fold.max()) + 1

    def beyond(self, model: ChangeModel, p: FloatArray, basic: int) -> JointFit:
        """With columns after the first `basic` that do nothing which those or the parameters could do near `p`.

        So the parameters keep their meaning, however many columns stand beside them.
        """
        around = model.simulate(np.concatenate([p[None], p + _STEP * np.eye(model.size)]))
        known = np.concatenate([(around[1:] - around[0]) / _STEP, self.shapes[:basic]])
        J = self.whitening(known).reshape(len(known), -1)
        matrix = J @ J.T
        matrix += 1e-6 * np.diag(np.diag(matrix)) + 1e-9 * np.eye(len(J))
        more = self.shapes[basic:]
        shares = np.linalg.solve(matrix, J @ self.whitening(more).reshape(len(more), -1).T).T
        return replace(self, shapes=np.concatenate([self.shapes[:basic], more - np.tensordot(shares, known, 1)]))

    def white(self, model: ChangeModel, p: FloatArray) -> FloatArray:
        """White residuals (..., channel, counted) of the model alone at `p` (..., size)."""
        return self.whitening(model.sides.whole.measured - model.simulate(p))

    def left(self, fit: Fit) -> FloatArray:
        """Residuals (channel, row) [m/s²] of a fit, its remainder included."""
        remainder = np.tensordot(fit.c / self.scale, self.shapes, 1)
        return fit.model.sides.whole.measured - fit.model.simulate(fit.p) - remainder

    # fits to all blocks --------------------------------------------------------------------------------------------
    def fit(self, model: ChangeModel, starts: FloatArray, *, iterations: int = 6) -> Fit:
        """From the best of `starts` (start, size)."""
        everything = np.ones(self.whitening.blocks)
        p, w, c, now = self._best(model, starts, everything)
        for _ in range(iterations):
            places = np.concatenate([self._steps(model, p, w, c, everything), model.traded(p).reshape(-1, model.size)])
            new = self._best(model, places, everything)
            gain = now - new[3]
            if gain > 0:
                p, w, c, now = new
            if gain < _STOP_NATS:
                break
        return Fit(model, p, c, now)

    def hold_out(self, fit: Fit) -> HeldOut:
        """Each fold held out in turn: steps from the fit to all blocks, the fold's blocks left out."""
        model = fit.model
        w = self.white(model, fit.p)
        slopes = (w - self.white(model, fit.p + _STEP * np.eye(model.size))) / _STEP
        grams = self._grams(np.concatenate([slopes, self.X, w[None]]))
        nats, p = np.empty(self.whitening.blocks), np.empty((self.folds, model.size))
        for k in range(self.folds):
            kept = (self.robust.fold != k).astype(float)
            moved, _ = self._linear(model, grams, kept, fit.p, fit.c)
            near = np.clip(fit.p + np.array([0.0, 0.5, 1.0])[:, None] * np.clip(moved, -_LONGEST, _LONGEST),
                           model.low, model.high)  # fmt: skip
            p[k], white, c, _ = self._best(model, near, kept)
            cost = self.robust.nats(white - np.tensordot(c, self.X, 1))
            nats[self.robust.fold == k] = cost[self.robust.fold == k]
        return HeldOut(nats, p)

    def _best(
        self, model: ChangeModel, places: FloatArray, weights: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray, float]:
        """The best of `places` (place, size), its white residuals, coefficients and cost."""
        white = self.white(model, places)
        best: tuple[FloatArray, FloatArray, FloatArray, float] | None = None
        inner = self._inner
        centre, precision = self._prior(model)
        for p, w in zip(places, white, strict=True):
            c = self._coefficients(w, weights, inner)
            left = self.robust.nats(w - np.tensordot(c, self.X, 1)) @ weights
            cost = float(left + 0.5 * precision @ (p - centre) ** 2 + 0.5 * self.penalty * c @ c)
            if best is None or cost < best[3]:
                best = p, w, c, cost
        assert best is not None
        return best

    def _prior(self, model: ChangeModel) -> tuple[FloatArray, FloatArray]:
        """Centre and precision (size,) of a normal prior of the coordinates."""
        centre, precision = np.zeros(model.size), np.ones(model.size)
        for key, at in model.index.items():
            value = self.anchor.get(key, self.anchor.get(key.removeprefix(AFTER)))
            if value is not None:
                centre[at] = value
                precision[at] = 1.0 if key.startswith(AFTER) else 1 / _NEAR**2
        return centre, precision

    def _coefficients(self, w: FloatArray, weights: FloatArray, inner: FloatArray) -> FloatArray:
        """The remainder's coefficients (column,) for white residuals `w` (channel, counted) of the model alone."""
        first = self.whitening.first
        outer = np.add.reduceat(np.einsum("cik,ik->ck", self.X, w), first, axis=-1)  # (column, block)
        total = self.whitening.by_block(w**2)
        c, scale = np.zeros(len(self.X)), weights
        for _ in range(_REWEIGHTED):
            matrix = np.tensordot(scale, inner, 1) + self.penalty * np.eye(len(c))
            c = np.linalg.solve(matrix, outer @ scale)
            squares = total - 2 * c @ outer + np.einsum("bij,i,j->b", inner, c, c)
            scale = weights * 2 * self.robust.half / (self.robust.prior + np.maximum(squares, 0.0))
        return np.asarray(c, float)

    @property
    def _inner(self) -> FloatArray:
        """(block, column, column)"""
        known = self.__dict__.get("_inner_sums")
        if known is None:
            known = self._grams(self.X)
            object.__setattr__(self, "_inner_sums", known)
        return known

    def _grams(self, stacked: FloatArray) -> FloatArray:
        """Sums (block, i, j) of products of `stacked` (i, channel, counted)."""
        ends = np.append(self.whitening.first, stacked.shape[-1])
        parts = [stacked[..., a:b].reshape(len(stacked), -1) for a, b in pairwise(ends)]
        return np.asarray(np.stack([x @ x.T for x in parts]))

    def _linear(
        self,
        model: ChangeModel,
        grams: FloatArray,
        weights: FloatArray,
        p: FloatArray,
        c: FloatArray,
        damping: float = 0.0,
    ) -> tuple[FloatArray, FloatArray]:
        """Step (size,) from `p` and coefficients (column,), from sums of slopes, columns and residuals."""
        size, last = len(p), grams.shape[-1] - 1
        x = np.concatenate([np.zeros(size), c])
        centre, precision = self._prior(model)
        prior = np.concatenate([precision, np.full(last - size, self.penalty)])
        pull = np.concatenate([precision * (p - centre), np.zeros(last - size)])
        for _ in range(_REWEIGHTED if damping == 0 else 1):
            left = np.append(-x, 1.0)
            squares = np.einsum("bij,i,j->b", grams, left, left)
            scale = weights * 2 * self.robust.half / (self.robust.prior + np.maximum(squares, 0.0))
            total = np.tensordot(scale, grams, 1)
            matrix = total[:last, :last] + np.diag(prior)
            matrix[:size, :size] += damping * np.diag(np.diag(matrix[:size, :size]))
            x = np.linalg.solve(matrix, total[:last, last] - pull)
        x = np.asarray(x, float)
        return x[:size], x[size:]

    def _steps(
        self, model: ChangeModel, p: FloatArray, w: FloatArray, c: FloatArray, weights: FloatArray
    ) -> FloatArray:
        """Places (step, size) to try from `p`, more and less damped."""
        slopes = (w - self.white(model, p + _STEP * np.eye(model.size))) / _STEP
        grams = self._grams(np.concatenate([slopes, self.X, w[None]]))
        out = []
        for damping in _DAMPING:
            step, _ = self._linear(model, grams, weights, p, c, damping)
            step = step * min(1.0, _LONGEST / max(float(np.abs(step).max()), 1e-12))
            out += [np.clip(p + share * step, model.low, model.high) for share in (1.0, 0.4)]
        return np.array(out)

    # a column in addition ------------------------------------------------------------------------------------------
    def sizes(self, fit: Fit, added: FloatArray, free: int | None = None) -> tuple[FloatArray, FloatArray]:
        """Coefficients and their standard errors (column,) of `added` columns (column, channel, row) beside a fit.

        Only the first `free` coordinates of its model move with them (default: all).

        By a jackknife over blocks: what blocks disagree on is in the error, which is infinite for a column that the
        drives do not show.
        """
        model, count = fit.model, len(added)
        free = model.size if free is None else free
        w = self.white(model, fit.p)
        slopes = (w - self.white(model, fit.p + _STEP * np.eye(model.size)[:free])) / _STEP
        extra = self.whitening(added)
        grams = self._grams(np.concatenate([extra, slopes, self.X, w[None]]))
        last = grams.shape[-1] - 1
        x = np.concatenate([np.zeros(count + free), fit.c])
        # the added columns are free
        own = np.einsum("bii->i", grams)[:count]
        shown = own > _SHOWN * own.max(initial=0.0)
        centre, precision = self._prior(model)
        prior = np.concatenate([np.where(shown, 0.0, 1.0), precision[:free], np.full(len(fit.c), self.penalty)])
        begun = np.concatenate([np.zeros(count), (fit.p - centre)[:free], np.zeros(len(fit.c))])
        scale = np.ones(self.whitening.blocks)
        for _ in range(_REWEIGHTED):
            left = np.append(-x, 1.0)
            squares = np.einsum("bij,i,j->b", grams, left, left)
            scale = 2 * self.robust.half / (self.robust.prior + np.maximum(squares, 0.0))
            x = _solved(np.asarray(np.tensordot(scale, grams, 1), float), prior, begun, last)
        blocks = len(scale)
        each = np.empty((blocks, count))
        for b in range(blocks):
            weights = scale.copy()
            weights[b] = 0.0
            each[b] = _solved(np.tensordot(weights, grams, 1), prior, begun, last)[:count]
        errors = np.sqrt((blocks - 1) / blocks * ((each - each.mean(0)) ** 2).sum(0))
        return np.where(shown, x[:count], 0.0), np.where(shown, errors, np.inf)


def _solved(total: FloatArray, prior: FloatArray, begun: FloatArray, last: int) -> FloatArray:
    matrix = total[:last, :last] + np.diag(prior)
    matrix += 1e-9 * np.diag(np.diag(matrix))
    return np.asarray(np.linalg.solve(matrix, total[:last, last] - begun * prior), float)
