"""A log without sensor noise, read as a good sensor on a quiet road would have read it.

The diagnosis takes every sensor to be noisy and every road to push a little, and what it weighs are misfits in units of
both. In a log straight from a simulator there is neither: round-off is then told apart from nothing with certainty, and
named. What is missing is added, the same in every run.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.signal import lfilter

from avtorch.arrays import FloatArray
from avtorch.gap.likelihood.noise_model import NoiseModel
from avtorch.io import Log

FINER = {"accel": 1e-3, "speed": 4e-4}
"""Less scatter from row to row than this [m/s², m/s] is no sensor's; rounding to three decimals leaves 3e-4."""
QUIET = NoiseModel(force_sd=0.005, force_time=3.0, accel_sd=0.02, speed_sd=0.01)
"""What is added: sensors as good as they come, and the force that the diagnosis expects anyway."""
_SEED = 20


def with_sensor_noise(log: Log) -> tuple[Log, str | None]:
    """`log` with noise in the channels that have none, and a sentence on it; itself and None if all have their own.

    Noise is told by third differences, which motion hardly has. A log of speed alone is left as it is: recordings of
    speed are mostly interpolated, and then as fine.
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
    told = []
    for name, sd, unit in (("accel", QUIET.accel_sd, "m/s²"), ("speed", QUIET.speed_sd, "m/s")):
        if name in bare:
            read[name] = read[name] + sd * white[name]
            told.append(f"{name} ({sd:g} {unit})")
    added = f"the diagnosis adds noise to {' and '.join(told)}"
    return replace(log, **read), f"No sensor noise in {' and '.join(bare)}, as if simulated: {added}."


def _force(log: Log, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """An Ornstein-Uhlenbeck force [m/s²] and the speed [m/s] that it gains, (time,), anew in each drive."""
    force, gained = np.zeros(log.rows), np.zeros(log.rows)
    for part in _drives(log):
        dt = np.diff(log.elapsed[part], append=log.elapsed[part][-1])
        keep = np.exp(-float(np.median(dt)) / QUIET.force_time)
        kicks = QUIET.force_sd * np.sqrt(1 - keep**2) * rng.standard_normal(len(dt))
        kicks[0] = QUIET.force_sd * rng.standard_normal()
        force[part] = lfilter([1.0], [1.0, -keep], kicks)
        gained[part] = np.concatenate([[0.0], np.cumsum(force[part] * dt)[:-1]])
    return force, gained


def _drives(log: Log) -> list[slice]:
    """Those long enough to tell noise by: `engaged` may come and go with every row."""
    return [part for part in log.drives() if part.stop - part.start > 3]


def _scatter(log: Log, signal: FloatArray) -> float:
    """SD of white noise that would bend `signal` from row to row as much as it is bent in a fifth of them or more.

    Half of them would do, but for signals that were interpolated from few rows: those bend at each of the few only.
    """
    together = np.concatenate([np.abs(np.diff(signal[part], n=3)) for part in _drives(log)] or [[]])
    # four fifths of a normal's absolute values are below this; the norm of (1, -3, 3, -1)
    return float(np.quantile(together, 0.8)) / 1.2816 / np.sqrt(20.0) if len(together) else np.inf
