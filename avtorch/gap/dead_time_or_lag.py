"""Whether a change of lag and gain, or one of dead time, explains the difference between two sets of drives.

To GLVD, a car that responds 0.15 s later resembles one with a longer lag. Both sides are therefore fitted with a dead
time as well, and two explanations are compared: only lag and gain differ (equal dead times), or only the dead time
differs (equal lag and gain). Each is a hypothesis on the difference of the two fits, tested by Hotelling's test with
spreads estimated from blocks, as in `compare`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.stats import f as fisher
from scipy.stats import t as student

from avtorch.arrays import FloatArray
from avtorch.gap.blocks import FEWEST_BLOCKS, blocks_of
from avtorch.gap.likelihood.gauss_newton import whitened_jacobian
from avtorch.gap.quantity import Quantity
from avtorch.gap.result.comparison import DeadTimeTest
from avtorch.gap.search.fitted_model import FittedModel
from avtorch.gap.search.own_noise_fit import OwnNoiseFits
from avtorch.gap.simulator.effect import delay_effect, delay_key

_FELT_S = 0.03  # [s] shorter delays: the link's scale, a logarithm, has no usable derivative there


@dataclass(frozen=True, eq=False)
class DeadTimeFit:
    """One set of drives: `mean` and `covariance` of ln T_L, ln K_L and the dead time [s], from `blocks` blocks."""

    mean: FloatArray
    covariance: FloatArray = field(repr=False)
    blocks: int

    @classmethod
    def of(cls, fits: OwnNoiseFits, none: FittedModel) -> DeadTimeFit:
        """With a dead time on top of `none`, the fit without any effect, in place of one of the baseline's."""
        found = fits.with_effects(none, [delay_effect()])
        candidate, record = found.hypothesis, found.hypothesis.record
        keys, own = [c.key for c in candidate.coordinates], _keys()
        here = found.z.copy()
        delay = keys.index(own[2])
        here[delay] = max(here[delay], candidate.coordinates[delay].z_of(_FELT_S))
        columns = whitened_jacobian(candidate, found.white, here).reshape(len(here), -1)
        # from the fit's coordinates to logarithms and seconds
        columns = np.stack([columns[keys.index(k)] / slope for k, slope in zip(own, _slopes(found, here), strict=True)])
        white = found.white(found.errors).ravel()
        inverse = np.linalg.inv(columns @ columns.T)
        pulls = columns * white
        by_row = pulls.reshape(len(own), len(record.channels), record.rows, record.group).sum((1, 3))
        blocks = blocks_of(record, fewest=FEWEST_BLOCKS)
        scores = np.stack([by_row[:, b].sum(1) for b in blocks], 1)
        values = [found.values[key] for key in own]
        # undo the prior's shrinkage and the constraint at zero delay: the estimate may be below 0
        mean = np.array([np.log(values[0]), np.log(values[1]), values[2]]) + inverse @ scores.sum(1)
        scores = scores - scores.mean(1, keepdims=True)
        between = scores @ scores.T * len(blocks) / (len(blocks) - 1)
        root = np.linalg.cholesky(inverse)
        sizes, axes = np.linalg.eigh(root.T @ between @ root)
        return cls(mean, root @ axes @ np.diag(np.maximum(sizes, 1.0)) @ axes.T @ root.T, len(blocks))


def compare_explanations(before: DeadTimeFit, after: DeadTimeFit, *, level: float) -> DeadTimeTest:
    """Test both explanations at `level` (see `DeadTimeTest`)."""
    away, covariance = after.mean - before.mean, after.covariance + before.covariance
    blocks = min(before.blocks, after.blocks)
    same_delay, same_car = _chance(away, covariance, [2], blocks), _chance(away, covariance, [0, 1], blocks)
    sure = float(student.ppf(0.95, blocks - 1))

    def delay(mean: float, variance: float) -> Quantity:
        sd = float(np.sqrt(variance))
        return Quantity(mean, sd, mean - sure * sd, mean + sure * sd)

    sides = [delay(float(x.mean[2]), float(x.covariance[2, 2])) for x in (before, after)]
    return DeadTimeTest(
        before=sides[0],
        after=sides[1],
        difference=delay(float(away[2]), float(covariance[2, 2])),
        p_lag_gain=same_delay,
        p_dead_time=same_car,
        level=level,
    )


def _chance(away: FloatArray, covariance: FloatArray, which: Sequence[int], blocks: int) -> float:
    """p-value of the difference in the parameters `which`, if they are equal (Hotelling)."""
    part, count = away[list(which)], len(which)
    square = float(part @ np.linalg.solve(covariance[np.ix_(which, which)], part))
    return float(fisher.sf(square * (blocks - count) / (count * (blocks - 1)), count, blocks - count))


def _keys() -> tuple[str, str, str]:
    """Keys of lag, gain and delay among the plant's parameters."""
    return "T_L", "K_L", delay_key()


def _slopes(found: FittedModel, z: FloatArray) -> list[float]:
    """Derivatives of ln T_L, ln K_L and the dead time [s] by their own coordinates at `z`."""
    step = 1e-4
    keys = [c.key for c in found.hypothesis.coordinates]
    each = found.hypothesis.values(z + step * np.vstack([np.zeros(len(z)), np.eye(len(z))]))
    out = []
    for key in _keys():
        x = each[key].numpy()
        x = x if key == delay_key() else np.log(x)
        out.append(float(x[1 + keys.index(key)] - x[0]) / step)
    return out
