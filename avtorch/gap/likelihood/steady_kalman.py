"""The steady-state Kalman filter of a noise model, as a filter from errors to innovations of unit covariance.

The interval between rows is integrated exactly; the filter uses the steady-state gain, which is reached within some
rows.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.linalg import expm

from avtorch.arrays import Float, FloatArray
from avtorch.gap.likelihood.noise_model import NoiseModel
from avtorch.gap.likelihood.state_space import StateSpace

Filter = tuple[StateSpace, float]
"""From errors to innovations of unit covariance, and the log det of their covariance before."""


def designed(noises: Sequence[NoiseModel], dt: float, channels: tuple[str, ...]) -> list[Filter]:
    """The steady-state Kalman filter from errors to innovations of unit covariance, for each noise model.

    Either all models or none have a sensor lag, and the same holds for a further force.
    """
    pairs = [error_dynamics(n, dt) for n in noises]
    move, driven = np.stack([p[0] for p in pairs]), np.stack([p[1] for p in pairs])
    use = [i for i, name in enumerate(("accel", "speed")) if name in channels]
    keep = slice(0 if 1 in use else 1, move.shape[-1])
    states = move.shape[-1]
    felt = [*[0] * (states - 1), 1] if noises[0].sensor_lag > 0 else [0, *[1] * (states - 1)]
    seen = np.array([[felt, [1, *[0] * (len(felt) - 1)]]] * len(noises), float)
    seen[:, 0] *= np.array([n.sensor_scale for n in noises])[:, None]
    see = seen[:, use][..., keep]
    white = np.stack([np.diag(np.array([n.accel_sd**2, n.speed_sd**2])[use]) for n in noises])
    move, driven = move[:, keep, keep], driven[:, keep, keep]
    ahead = _steady(move, see, driven, white)
    s = see @ ahead @ see.mT + white
    gain = move @ ahead @ see.mT @ np.linalg.inv(s)
    mix = np.linalg.inv(np.linalg.cholesky(s))
    inner = move - gain @ see
    tops = -(mix @ see)
    sizes = np.linalg.slogdet(s)[1].tolist()
    return [(StateSpace(*own), size) for *own, size in zip(inner, gain, tops, mix, sizes, strict=True)]


def error_dynamics(
    n: NoiseModel, dt: float
) -> tuple[Float[FloatArray, "state state"], Float[FloatArray, "state state"]]:
    """Exact transition of the state (error of the speed, p, d) over `dt`, and the covariance of its process noise.

    The state holds Ornstein-Uhlenbeck processes (a third where a random effect adds one) and the integral of their sum.
    With a sensor lag the sensor's reading is one further state, the last.
    """
    if n.sensor_lag > 0:
        return _late_motion(n, dt)
    size = 1 + len(n.forces)
    move, driven = np.eye(size), np.zeros((size, size))
    # a little speed noise, or the error of the speed would be known exactly
    driven[0, 0] = 1e-12 * dt
    for i, (sd, time) in enumerate(n.forces, start=1):
        lost = -np.expm1(-dt / time)
        move[i, i], move[0, i] = 1 - lost, time * lost
        driven[i, i] = sd**2 * lost * (2 - lost)
        driven[0, i] = driven[i, 0] = sd**2 * time * lost**2
        driven[0, 0] += sd**2 * time**2 * _integral(dt / time)
    return move, driven


def _late_motion(n: NoiseModel, dt: float) -> tuple[FloatArray, FloatArray]:
    """The same with a sensor lag, by van Loan's matrix exponential."""
    size = 2 + len(n.forces)
    drift = np.diag([0.0, *(-1 / time for _, time in n.forces), -1 / n.sensor_lag])
    drift[0, 1:-1], drift[-1, 1:-1] = 1.0, 1 / n.sensor_lag
    spectrum = np.diag([1e-12, *(2 * sd**2 / time for sd, time in n.forces), 0.0])
    # the step is halved until the growing half of the matrix stays small, then doubled back
    halves = max(0, int(np.ceil(np.log2(dt / n.sensor_lag))) + 1)
    step = np.asarray(expm(np.block([[-drift, spectrum], [np.zeros((size, size)), drift.T]]) * dt / 2**halves), float)
    move = step[size:, size:].T
    driven = move @ step[:size, size:]
    for _ in range(halves):
        driven = driven + move @ driven @ move.T
        move = move @ move
    return np.asarray(move, float), np.asarray(0.5 * (driven + driven.T), float)


def _integral(x: float) -> float:
    """Variance of the integral of a unit process over `x` time constants: 2 x - 3 + 4 exp(-x) - exp(-2 x)."""
    if x < 0.02:  # the series, because the terms above cancel
        return x**3 * (2 / 3 - x / 2 + 7 * x**2 / 30 - x**3 / 12)
    return 2 * x - 3 + 4 * float(np.exp(-x)) - float(np.exp(-2 * x))


def _steady(
    move: Float[FloatArray, "model state state"],
    see: Float[FloatArray, "model seen state"],
    driven: Float[FloatArray, "model state state"],
    white: Float[FloatArray, "model seen seen"],
) -> Float[FloatArray, "model state state"]:
    """Steady-state prediction covariances (model, state, state): the Riccati equation solved by doubling.

    Structure-preserving doubling (Anderson 1978): each round covers twice as many rows as the last.
    """
    a, g, h = move.mT, see.mT @ np.linalg.solve(white, see), driven
    one = np.eye(move.shape[-1])
    for _ in range(60):
        inside = np.linalg.inv(one + g @ h)
        left, more = a @ inside, a.mT @ h @ inside @ a
        g = g + left @ g @ a.mT
        a = left @ a
        h = h + more
        if bool((np.abs(more).max((-1, -2)) <= 1e-14 * np.abs(h).max((-1, -2))).all()):
            break
    return np.asarray(0.5 * (h + h.mT), float)
