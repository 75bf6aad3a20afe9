"""Lag and gain of one set of drives, with a spread that holds what its blocks disagree on.

GLVD, or the user's baseline, is fitted behind a recorder of unknown delay and filter, as every diagnosis begins. Each
block of the drives pulls at the fit; their scatter is the covariance's (the sandwich of White 1982), which is
never less than the posterior's.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from avtorch.arrays import FloatArray
from avtorch.errors import InputError
from avtorch.gap.drive_record import FEWEST_BLOCKS, Record, blocks_of
from avtorch.gap.engine.drive_data import DriveData
from avtorch.gap.engine.gauss_newton import jacobian, prior_terms, whitened_jacobian
from avtorch.gap.engine.joint import block_scores
from avtorch.gap.engine.priors import ONE_CHANNEL_HZ
from avtorch.gap.engine.recorder import base_fit
from avtorch.gap.rollout_errors import rolled_out
from avtorch.gap.simulator.plant import GapPlant
from avtorch.io import Log

CAR = ("T_L", "K_L")
_TURNS = 12  # of Gauss-Newton


@dataclass(frozen=True, eq=False)
class LagAndGain:
    """One set of drives, `record`: `mean` and `covariance` of ln T_L and ln K_L, estimated from `blocks` blocks."""

    record: Record = field(repr=False)
    mean: FloatArray
    covariance: FloatArray = field(repr=False)
    blocks: int

    @classmethod
    def of(cls, logs: Sequence[Log], base: GapPlant, which: str) -> LagAndGain:
        record = Record.of(logs)
        blocks = blocks_of(record, fewest=FEWEST_BLOCKS)
        if len(blocks) < FEWEST_BLOCKS:
            raise InputError(
                f"{which}: found {len(blocks)} blocks of 4 s of usable driving, needs {FEWEST_BLOCKS} or more"
            )
        try:
            data = DriveData.of(logs)
        except InputError:  # no stretch that is long enough for the engine
            mean, information, scores = _by_rows(record, base, blocks)
        else:
            mean, information, scores = _by_engine(data, base)
        scores = scores - scores.mean(1, keepdims=True)
        count = scores.shape[1]
        between = scores @ scores.T * count / (count - 1)
        inverse = np.linalg.inv(information)
        root = np.linalg.cholesky(0.5 * (inverse + inverse.T))
        # in coordinates that whiten the posterior: the spread is no smaller than the posterior's in any direction
        sizes, axes = np.linalg.eigh(root.T @ between @ root)
        spread = root @ axes @ np.diag(np.maximum(sizes, 1.0)) @ axes.T @ root.T
        return cls(record, mean, spread[:2, :2], count)

    def fitted(self, base: GapPlant) -> GapPlant:
        """The simulator with this lag and gain."""
        return base.with_values(dict(zip(CAR, np.exp(self.mean).tolist(), strict=True)))


def _by_engine(data: DriveData, base: GapPlant) -> tuple[FloatArray, FloatArray, FloatArray]:
    """ln T_L and ln K_L (2,) behind a recorder; information (parameter, parameter) and scores (parameter, block)."""
    alone = data.channel_count == 1
    h = base_fit(data.below(ONE_CHANNEL_HZ) if alone else data, base, alone=alone)
    names = h.free
    J = jacobian(h, names)
    here = np.array([h[name] for name in CAR])
    slopes = np.array([*here, *np.ones(len(names) - 2)])  # of the parameters by the logarithms of the first two
    W = whitened_jacobian(h, J) * slopes[:, None]
    information = W @ W.T + np.diag(prior_terms(h, names)[0] * slopes**2)
    return np.log(here), information, block_scores(h, h.covariance, J, h.residual) * slopes[:, None]


def _by_rows(record: Record, base: GapPlant, blocks: Sequence[slice]) -> tuple[FloatArray, FloatArray, FloatArray]:
    """The same of rows with white noise of any covariance, for stretches that are too short for a spectrum."""

    def errors(z: FloatArray) -> FloatArray:
        """(channel, row): of acceleration, and of the speed's rise between rows."""
        car = base.with_values(dict(zip(CAR, np.exp(z).tolist(), strict=True)))
        e = (record.measured - rolled_out(record, car)).mean(-1)
        for k, channel in enumerate(record.channels):
            if channel == "speed":
                e[k] = np.diff(e[k], prepend=e[k, :1]) / record.dt
                e[k, record.starts] = 0.0
        return e

    z, step = np.log([float(base.T_L), float(base.K_L)]), 1e-3
    information, scores = np.eye(2), np.zeros((2, record.rows))
    for _ in range(_TURNS):
        e = errors(z)
        weight = np.linalg.inv(e @ e.T / e.shape[1])
        J = np.stack([(e - errors(z + step * unit)) / step for unit in np.eye(2)])
        weighted = np.einsum("pct,cd->pdt", J, weight)
        information = np.einsum("pdt,qdt->pq", weighted, J) + np.eye(2)
        scores = np.einsum("pdt,dt->pt", weighted, e)
        z = z + np.clip(np.linalg.solve(information, scores.sum(1)), -0.5, 0.5)
    return z, information, np.stack([scores[:, b].sum(1) for b in blocks], 1)
