"""Draws of a rollout's errors from their noise model."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from avtorch.gap.likelihood.noise_model import NoiseModel

Float = NDArray[np.float64]


def noise_draws(
    noise: NoiseModel, rows: int, dt: float, witnesses: tuple[str, ...], count: int, rng: np.random.Generator
) -> Float:
    """(draw, witness, row) at rows `dt` [s] apart; the error of the speed begins at 0, its sensor's noise apart."""
    process = _coloured(noise.process_sd, noise.process_time, rows, dt, count, rng)
    motion = process + _coloured(noise.force_sd, noise.force_time, rows, dt, count, rng)
    out = []
    for name in witnesses:
        if name == "accel":
            seen = noise.sensor_scale * motion
            if noise.sensor_lag > 0:
                lost = -np.expm1(-dt / noise.sensor_lag)
                seen = np.asarray(lfilter([lost], [1, lost - 1], seen, axis=-1))
            out.append(seen + noise.accel_sd * rng.standard_normal((count, rows)))
        else:
            gained = np.cumsum(0.5 * dt * (motion[:, 1:] + motion[:, :-1]), -1)
            speed = np.concatenate([np.zeros((count, 1)), gained], -1)
            out.append(speed + noise.speed_sd * rng.standard_normal((count, rows)))
    return np.stack(out, 1)


def _coloured(sd: float, time: float, rows: int, dt: float, count: int, rng: np.random.Generator) -> Float:
    """A stationary Ornstein-Uhlenbeck process, (draw, row)."""
    keep = float(np.exp(-dt / max(time, 1e-6)))
    white = rng.standard_normal((count, rows))
    white[:, 1:] *= np.sqrt(1 - keep**2)
    return sd * np.asarray(lfilter([1.0], [1.0, -keep], white, axis=-1))
