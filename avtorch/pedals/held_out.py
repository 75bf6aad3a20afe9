"""What a map is worth: free runs over blocks left out, beside those of one constant a pedal.

Lag, dead time and the sizes of the free form are those of the whole drive; forces are fitted without the block.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from avtorch.arrays import FloatArray
from avtorch.gap.result.budget import HORIZON_S
from avtorch.gap.result.free_form import Fit, LeftOut, Prior, Products, Sizes, drive


@dataclass(frozen=True, eq=False)
class HeldOut:
    """Mean squared errors of speed `squares` (block,) [m²/s²] by model: `map`, and `factor`, one constant a pedal.
    `horizon_s`: the longest of the free runs [s], begun every second of a block.

    Example:
        >>> import numpy as np
        >>> from avtorch.pedals import HeldOut
        >>> better = HeldOut({"map": np.array([0.1, 0.2, 0.1]), "factor": np.array([1.0, 1.3, 1.1])}, 10.0)
        >>> round(better.rmse("factor"), 2), better.better_than("factor")
        (1.06, True)
    """

    squares: Mapping[str, FloatArray]
    horizon_s: float

    def rmse(self, model: str) -> float:
        """Root of the mean squared error of speed [m/s]."""
        return float(np.sqrt(self.squares[model].mean()))

    def gain(self, over: str, *, of: str = "map") -> tuple[float, float]:
        """By how much the squared error of `of` is below that of `over`, block by block, and its standard error."""
        less = self.squares[over] - self.squares[of]
        return float(less.mean()), float(less.std(ddof=1) / np.sqrt(len(less)))

    def better_than(self, over: str) -> bool:
        """Whether the map's gain is above two of its standard errors."""
        gain, error = self.gain(over)
        return gain > 2 * error


def scored(of: Mapping[str, tuple[Fit, Sizes]], left: LeftOut, independent: float) -> HeldOut:
    """The score of fits whose blocks are left out in turn: a fifth to a tenth of them, every so-many-th one."""
    out, horizon = {}, 0.0
    for model, (fit, sizes) in of.items():
        taught = Fit(fit.car, fit.x, cut=True)
        steps = Products(taught, left).steps(Prior(fit.car, sizes), independent)
        car = fit.car.with_runs(HORIZON_S)
        runs = car.runs(float(fit.x[-1]), cut=True)
        block, own = (np.searchsorted(car.edges, first, side="right") for first in (runs.first, taught.runs.counts))
        squares = np.full(len(block), np.nan)
        for is_told, step in zip(left.told[left.way == 0], steps[left.way == 0], strict=True):
            told = np.isin(block, own[is_told])
            mean = np.bincount(runs.of_run, drive(car, fit.x + step, cut=True)[0] ** 2, len(told))
            squares[told] = mean[told] / np.bincount(runs.of_run, minlength=len(told))[told]
        runs_told = np.isfinite(squares)
        block, squares = block[runs_told], squares[runs_told]
        out[model] = np.array([squares[block == k].mean() for k in np.unique(block)])
        horizon = float((runs.end - runs.first).max()) * car.rows.dt
    return HeldOut(out, horizon)
