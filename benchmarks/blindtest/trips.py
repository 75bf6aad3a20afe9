"""Leader speeds: synthetic trips similar to the WLTC, stop-and-go queues, and the US06 cycle."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import gaussian_filter1d

from avtorch.arrays import FloatArray
from avtorch.io.us06 import US06_SPEED_MPS
from benchmarks.blindtest.body import coloured

_SMOOTH_S = 0.7


def trip(rng: np.random.Generator, seconds: float, dt: float) -> FloatArray:
    """Town, road and motorway in turn, (row,) [m/s]: accelerations, holds with drift, slow-downs, occasional stops."""
    knots, speeds, time = [0.0], [float(rng.uniform(8, 20))], 0.0
    kind = int(rng.integers(3))
    left = float(rng.uniform(40, 120))
    while time < seconds:
        low, high = ((3.0, 14.0), (9.0, 24.0), (18.0, 33.0))[kind]
        target = float(rng.uniform(low, high))
        if kind == 0 and rng.random() < 0.2:
            target = 0.0
        pull = float(rng.uniform(0.4, 1.6) if target > speeds[-1] else rng.uniform(0.5, 2.2))
        takes = abs(target - speeds[-1]) / pull + 0.5
        holds = float(rng.uniform(3, 8) if target == 0 else rng.exponential(9.0) + 2.0)
        for more, speed in ((takes, target), (holds, target)):
            time += more
            knots.append(time)
            speeds.append(speed)
        left -= takes + holds
        if left < 0:
            kind, left = int(rng.integers(3)), float(rng.uniform(40, 120))
    return _smooth(np.interp(np.arange(0, seconds + 1, dt), knots, speeds), rng, dt)


def queue(rng: np.random.Generator, seconds: float, dt: float) -> FloatArray:
    """Stop-and-go, (row,) [m/s]: short accelerations to 2 to 12 m/s, stops of a few seconds."""
    knots, speeds, time = [0.0], [float(rng.uniform(3, 8))], 0.0
    while time < seconds:
        target = float(rng.uniform(2, 12)) if speeds[-1] < 1.5 or rng.random() < 0.4 else float(rng.uniform(0, 1.5))
        target = 0.0 if target < 1.0 else target
        takes = abs(target - speeds[-1]) / float(rng.uniform(0.6, 2.0)) + 0.5
        holds = float(rng.uniform(2, 6))
        for more in (takes, holds):
            time += more
            knots.append(time)
            speeds.append(target)
    return _smooth(np.interp(np.arange(0, seconds + 1, dt), knots, speeds), rng, dt)


def us06(rng: np.random.Generator, seconds: float, dt: float) -> FloatArray:
    """A stretch of the US06 cycle from a random start, repeated from its beginning after its end, (row,) [m/s]."""
    grid = np.arange(0, seconds + 1, dt) + rng.uniform(0, len(US06_SPEED_MPS))
    table = np.asarray(US06_SPEED_MPS, float)
    speed = np.interp(grid, np.arange(len(table)), table, period=len(table))
    return np.asarray(np.maximum(gaussian_filter1d(speed, _SMOOTH_S / dt), 0.0))


def _smooth(speed: FloatArray, rng: np.random.Generator, dt: float) -> FloatArray:
    """Smoothed corners, and a driver's small random variation, which vanishes towards a stop."""
    wander = gaussian_filter1d(coloured(rng, len(speed), float(rng.uniform(0.2, 0.7)), 6.0, dt), 0.8 / dt)
    rounded = gaussian_filter1d(speed, _SMOOTH_S / dt)
    return np.asarray(np.maximum(rounded + wander * np.clip(rounded / 5.0, 0.0, 1.0), 0.0))
