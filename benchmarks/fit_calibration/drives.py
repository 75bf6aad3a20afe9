"""Short fixed drives, the same to the last digit with any version of NumPy, for the likelihood's fingerprint.

They share no code with avtorch, so that only a change of the likelihood can change its values on them.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.special import ndtri

from avtorch.arrays import FloatArray
from avtorch.io import Log

_LAG_S, _GAIN, _GRAVITY = 0.35, 0.95, 9.81
_PROCESS, _ACCEL, _SPEED = 0.05, 0.05, 0.02  # noise [m/s², m/s², m/s]


def drive(
    seed: int,
    *,
    seconds: float,
    rate_hz: int,
    delay_s: float = 0.0,
    since_s: float = 0.0,
    slope: float = 0.0,
    scale: float = 1.0,
    held: Sequence[slice] = (),
    glitches: Sequence[int] = (),
) -> Log:
    """A car of lag 0.35 s and gain 0.95, from 18 m/s on, on a fixed command.

    `delay_s`: of the commands from `since_s` on. `slope`: of a wavy road, rise over run. `scale`: of the accelerometer.
    `held`: rows through which the command before them is kept. `glitches`: rows 1.5 m/s² off, to either side in turn.
    """
    dt = 1 / rate_hz
    time = np.arange(round(seconds * rate_hz)) * dt
    steps = np.array([0.7, -0.6, 0.3, -0.4])[(time / 3.5).astype(int) % 4]
    command = steps + 0.5 * np.sin(0.9 * time) + 0.3 * np.sin(2.7 * time + 1)
    felt = np.where(time >= since_s, np.interp(time - delay_s, time, command), command)
    for rows in held:
        felt[rows] = felt[rows.start - 1]
    white = normal(seed, 3, len(time))
    keep = np.exp(-dt / _LAG_S)
    accel, pushed = np.zeros(len(time)), np.zeros(len(time))
    for k in range(1, len(time)):
        accel[k] = keep * accel[k - 1] + (1 - keep) * _GAIN * felt[k - 1]
        pushed[k] = keep * pushed[k - 1] + _PROCESS * np.sqrt(1 - keep**2) * white[0, k]
    accel = accel + pushed - _GRAVITY * slope * np.sin(0.3 * time)
    gained = np.cumsum(0.5 * dt * (accel[1:] + accel[:-1]))
    speed = 18.0 + np.concatenate([[0.0], gained]) + _SPEED * white[1]
    read = scale * accel + _ACCEL * white[2]
    for i, row in enumerate(glitches):
        read[row] += 1.5 * (-1) ** i
    return Log.from_arrays(name=f"drive {seed}", time=time, accel_cmd=command, accel=read, speed=speed)


def normal(seed: int, *shape: int) -> FloatArray:
    """Standard normal numbers from the bits of PCG64: NumPy promises those to stay, those of a `Generator` not."""
    bits = np.random.PCG64(seed).random_raw(int(np.prod(shape)))
    return np.asarray(ndtri(((np.asarray(bits) >> 11) + 0.5) / 2.0**53), np.float64).reshape(shape)
