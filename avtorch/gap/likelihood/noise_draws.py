"""Draws of rollout errors from their noise model, by the exact discretisation that its filter uses."""

from __future__ import annotations

import numpy as np
from scipy.linalg import solve_discrete_lyapunov

from avtorch.arrays import Float, FloatArray
from avtorch.gap.likelihood.noise_model import NoiseModel
from avtorch.gap.likelihood.steady_kalman import error_dynamics


def noise_draws(
    noise: NoiseModel, rows: int, dt: float, channels: tuple[str, ...], count: int, rng: np.random.Generator
) -> Float[FloatArray, "draw channel row"]:
    """(draw, channel, row) at rows `dt` [s] apart; the speed's error starts at 0, except for its sensor noise."""
    move, driven = error_dynamics(noise, dt)
    # stationary states start from their stationary distribution
    start = np.zeros_like(move)
    start[1:, 1:] = solve_discrete_lyapunov(move[1:, 1:], driven[1:, 1:])
    root, first = _root(driven), _root(start)
    state = np.empty((rows, count, len(move)))
    state[0] = rng.standard_normal((count, len(move))) @ first.T
    pushed = rng.standard_normal((rows, count, len(move))) @ root.T
    for k in range(1, rows):
        state[k] = state[k - 1] @ move.T + pushed[k]
    accel = state[..., -1] if noise.sensor_lag > 0 else state[..., 1:].sum(-1)
    clean = {"accel": noise.sensor_scale * accel, "speed": state[..., 0]}
    sds = {"accel": noise.accel_sd, "speed": noise.speed_sd}
    return np.stack([clean[w].T + sds[w] * rng.standard_normal((count, rows)) for w in channels], 1)


def _root(covariance: FloatArray) -> FloatArray:
    values, axes = np.linalg.eigh(covariance)
    return np.asarray(axes * np.sqrt(np.maximum(values, 0.0)))
