"""Rollout errors and log densities of a refitted model on held-out blocks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from avtorch.arrays import BoolArray, FloatArray
from avtorch.gap.blocks import Fold
from avtorch.gap.crossval.closed_loop_errors import ClosedLoopMetric
from avtorch.gap.crossval.noise_floor import NoiseFloor
from avtorch.gap.crossval.refit import Refit
from avtorch.gap.drive_record import Record
from avtorch.gap.likelihood.whitening_filter import WhiteningFilter
from avtorch.gap.posterior.density import root
from avtorch.gap.rollout_errors import RolloutMetric, products


@dataclass(frozen=True, eq=False)
class FoldScores:
    """Sums over the rows of each block: `squares` (measure, block) of rollout errors, log density `nats` (block,)."""

    squares: FloatArray
    nats: FloatArray

    @classmethod
    def joined(cls, parts: Sequence[FoldScores]) -> FoldScores:
        """The blocks of several folds, concatenated."""
        return cls(np.concatenate([p.squares for p in parts], 1), np.concatenate([p.nats for p in parts]))


@dataclass(frozen=True)
class FoldScorer:
    """Scores models on the blocks of one fold. `lag` [s]: time constant with which an initial state is forgotten."""

    record: Record
    part: Fold
    metrics: Sequence[RolloutMetric | ClosedLoopMetric]
    lag: float

    def products(self, errors: FloatArray) -> FloatArray:
        """(measure, block, one, other) of errors (one, channel, counted, group)."""
        return np.stack([products(m, self.record, errors, self.part.blocks, self.lag) for m in self.metrics])

    def score(self, refit: Refit, *, less: FloatArray | None = None, chance: FloatArray | None = None) -> FoldScores:
        """Scores of a refit; `less`: prediction (channel, counted, 1) to subtract from its errors, `chance` (counted,)
        [nats]: term to add to the density of each row."""
        errors = refit.errors if less is None else refit.errors - less
        nats = self.row_nats(refit, less=less)
        return FoldScores(
            self.products(errors[None])[..., 0, 0], self._by_block(nats if chance is None else nats + chance)
        )

    def row_nats(self, refit: Refit, *, less: FloatArray | None = None) -> FloatArray:
        """Log density (counted,) of each held-out row, 0 elsewhere."""
        errors = refit.errors if less is None else refit.errors - less
        out = np.zeros(self.record.rows)
        rows = np.isin(self.record.source, self.part.held_out.source)
        out[rows] = self._white(refit).row_likelihoods(errors[:, rows])
        return out

    def floor(self, refit: Refit, images: FloatArray) -> NoiseFloor:
        """Noise floor of a refit whose parameters change its errors by `images` (axis, channel, counted, group)
        (`parameter_spread`)."""
        errors = np.concatenate([refit.errors[None], images])
        rows = np.isin(self.record.source, self.part.held_out.source)
        white = self._white(refit)(errors[:, :, rows])
        nats = np.empty((len(self.part.blocks), len(errors), len(errors)))
        number = self._block_of[rows]
        for j in range(len(nats)):
            some = white[:, :, number == j].reshape(len(errors), -1)
            nats[j] = 0.5 * some @ some.T
        return NoiseFloor(self.products(errors), nats)

    def _by_block(self, nats: FloatArray) -> FloatArray:
        """Sums (block,) over rows (counted,)."""
        return np.array([nats[b].sum() for b in self.part.blocks])

    @property
    def _block_of(self) -> NDArray[np.intp]:
        """Block number (counted,) of each row, -1 outside."""
        number = np.full(self.record.rows, -1)
        for j, block in enumerate(self.part.blocks):
            number[block] = j
        return number

    @property
    def inside(self) -> BoolArray:
        """Whether each counted row lies in one of the blocks (counted,)."""
        inside = np.zeros(self.record.rows, bool)
        inside[self.part.rows] = True
        return inside

    @property
    def rows(self) -> FloatArray:
        """Number of single rows per block, (block,)."""
        return np.array([(b.stop - b.start) * self.record.group for b in self.part.blocks], float)

    def _white(self, refit: Refit) -> WhiteningFilter:
        return refit.white(self.part.held_out)


def parameter_spread(refit: Refit) -> FloatArray:
    """Change of the errors by one standard deviation along each axis of the posterior, (axis, channel, counted, group).

    From the curvature on the fitted rows. A step is shortened where the joint density falls further than under a normal
    posterior.
    """
    count = len(refit.z)
    steps = root(refit.covariance).numpy().T
    around = refit.around(np.concatenate([np.zeros((1, count)), steps, -steps]))
    moved = around[1:] - around[:1]
    white = refit.white(refit.fits)
    fits = np.isin(refit.found.hypothesis.record.source, refit.fits.source)
    here, there = refit.errors[:, fits], moved[:, :, fits]
    lost = 0.5 * ((white(here - there) ** 2).sum((1, 2, 3)) - (white(here) ** 2).sum())
    # a standard deviation costs half a nat; mean of both signs
    lost = lost.reshape(2, -1).mean(0)
    images = 0.5 * (moved[:count] - moved[count:])
    images = images * np.sqrt(np.minimum(1.0, 0.5 / np.maximum(lost, 0.5)))[:, None, None, None]
    if refit.found.hypothesis.grade_columns is not None:
        images = np.concatenate([images, refit.slope_spread(white)])
    return images
