"""Lag and dead time with which a given demand becomes the measured motion."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from avtorch.arrays import BoolArray, FloatArray
from avtorch.pedals.lagged import delayed, speed_gained
from avtorch.pedals.normal_equations import Rows

LAGS_S = np.geomspace(0.03, 3.0, 25)
DEAD_TIMES_S = np.arange(0.0, 0.81, 0.05)


def lag_of(rows: Sequence[Rows], demand: Sequence[FloatArray], used: BoolArray) -> tuple[float, float]:
    """Lag and dead time [s], the best of a grid, by the blocks `used` (block,); `demand` (cell,) for each of `rows`."""
    best, found = np.inf, (0.3, 0.0)
    wanted = [one.means(np.diff(one.piece.speed)) for one in rows]
    counted = [used[one.block] for one in rows]
    for dead_time in DEAD_TIMES_S.tolist():
        late = [delayed(m, dead_time, one.piece.dt) for m, one in zip(demand, rows, strict=True)]
        for T_L in LAGS_S.tolist():
            left = 0.0
            for one, m, target, counts in zip(rows, late, wanted, counted, strict=True):
                off = one.means(speed_gained(m, T_L, one.piece.dt)[0]) - target
                left += float((off[counts] ** 2).sum())
            if left < best:
                best, found = left, (T_L, dead_time)
    return found
