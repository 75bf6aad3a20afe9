"""A demanded acceleration through dead time and first-order lag, exactly for what is held over each cell."""

from __future__ import annotations

import numpy as np
from scipy.signal import lfilter

from avtorch.arrays import FloatArray


def delayed(demand: FloatArray, dead_time: float, dt: float) -> FloatArray:
    """`demand` (cell, ...) later by `dead_time` [s]; before its beginning it was as at its first cell."""
    whole, part = int(dead_time / dt), dead_time / dt - int(dead_time / dt)

    def later(cells: int) -> FloatArray:
        return demand[np.maximum(np.arange(len(demand)) - cells, 0)]

    # a cell holds the end of one demand and the beginning of the next
    return later(whole) if part < 1e-9 else (1 - part) * later(whole) + part * later(whole + 1)


def speed_gained(demand: FloatArray, T_L: float, dt: float) -> tuple[FloatArray, FloatArray]:
    """What a lag `T_L` [s] makes of `demand` (cell, ...): speed gained in each cell [m/s], and the acceleration at its
    beginning [m/s²]. At the first cell the car is steady."""
    keep = np.exp(-dt / T_L)
    accel, _ = lfilter([0.0, 1 - keep], [1.0, -keep], demand, axis=0, zi=demand[:1] * 1.0)
    return demand * dt + (accel - demand) * T_L * (1 - keep), accel
