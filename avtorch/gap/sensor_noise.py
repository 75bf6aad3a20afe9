"""Adds sensor noise and a small road force to a log that has none.

The diagnosis scales residuals by sensor noise and by a small random force, and assumes both in every log. A log
straight from a simulator has neither, so round-off would appear significant and be attributed to a cause. The missing
noise is added, with the same draws in every run.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.signal import lfilter

from avtorch.arrays import FloatArray
from avtorch.io import Log

FINER = {"accel": 1e-3, "speed": 4e-4}
"""Row-to-row scatter below this [m/s², m/s] is not sensor noise; rounding to three decimals leaves 3e-4."""
ADDED = {"accel": 0.02, "speed": 0.01}
"""SD of the added noise [m/s², m/s]: that of very good sensors."""
_FORCE_SD = 0.005  # [m/s²] of the added force, which the diagnosis assumes in any case
_FORCE_S = 3.0  # its time constant [s]
_SEED = 20


def with_sensor_noise(log: Log) -> tuple[Log, str | None]:
    """`log` with noise added to the channels that have none, and a sentence on it; itself and None if all have noise.

    Noise is detected by third differences, in which motion is negligible. A log of speed alone is left unchanged:
    recorded speeds are often interpolated and then as smooth.
    """
    if log.accel is None:
        return log, None
    channels = {name: getattr(log, name) for name in FINER if getattr(log, name) is not None}
    bare = [name for name, x in channels.items() if _scatter(log, x) < FINER[name]]
    if not bare:
        return log, None
    rng = np.random.default_rng(_SEED)
    force, gained = _force(log, rng)
    white = {name: rng.standard_normal(log.rows) for name in FINER}
    read = {name: x + (force if name == "accel" else gained) for name, x in channels.items()}
    levels = []
    for name, unit in (("accel", "m/s²"), ("speed", "m/s")):
        if name in bare:
            read[name] = read[name] + ADDED[name] * white[name]
            levels.append(f"{name} ({ADDED[name]:g} {unit})")
    added = f"the diagnosis adds noise to {' and '.join(levels)}"
    return replace(log, **read), f"No sensor noise in {' and '.join(bare)}, as if simulated: {added}."


def _force(log: Log, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """An Ornstein-Uhlenbeck force [m/s²] and the speed [m/s] that it adds, (time,), independent in each drive."""
    force, gained = np.zeros(log.rows), np.zeros(log.rows)
    for part in _drives(log):
        dt = np.diff(log.elapsed[part], append=log.elapsed[part][-1])
        keep = np.exp(-float(np.median(dt)) / _FORCE_S)
        kicks = _FORCE_SD * np.sqrt(1 - keep**2) * rng.standard_normal(len(dt))
        kicks[0] = _FORCE_SD * rng.standard_normal()
        force[part] = lfilter([1.0], [1.0, -keep], kicks)
        gained[part] = np.concatenate([[0.0], np.cumsum(force[part] * dt)[:-1]])
    return force, gained


def _drives(log: Log) -> list[slice]:
    """Drives long enough to estimate noise: `engaged` may change with every row."""
    return [part for part in log.engaged_segments() if part.stop - part.start > 3]


def _scatter(log: Log, signal: FloatArray) -> float:
    """SD of white noise from the 80 % quantile of the third differences of `signal`.

    The median would do, but not for signals interpolated from few rows: only at those few do their differences vary.
    """
    together = np.concatenate([np.abs(np.diff(signal[part], n=3)) for part in _drives(log)] or [[]])
    # the 80 % quantile of a normal's absolute value is 1.2816; sqrt(20) is the norm of (1, -3, 3, -1)
    return float(np.quantile(together, 0.8)) / 1.2816 / np.sqrt(20.0) if len(together) else np.inf
