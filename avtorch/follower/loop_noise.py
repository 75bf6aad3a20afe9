"""The noise of a follower's speed: what its controller does that no law predicts, in the engine's coefficients.

    V(f) = G(f)^2 [ 2 p^2 t / (1 + (w t)^2) + 2 s^2 tau / (1 + (w tau)^2) ] / dt + (w G(f))^2 r^2,    w = 2 pi f

jerk noise behind the lag, a slow force, and white noise of the measured speed, as a difference over rows dt apart sees
them (G). The diagnosis leaves the spectrum free; here it has this shape, and sizes with priors. With one channel and a
law that misses much, free bands are given up one by one: the loop is then fitted to the quietest, in which a recorder's
smoothing is all there is.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from avtorch.arrays import FloatArray
from avtorch.gap.engine.drive_data import DriveData

_PRIORS = np.array(
    [
        (np.log(0.05), 1.2),  # p [m/s²]
        (0.0, 0.3),  # t, over T_L
        (np.log(0.1), 1.0),  # s [m/s²]
        (np.log(2.2), 0.63),  # tau [s]
        (np.log(0.02), 1.2),  # r [m/s]
    ]
)
"""Mean and standard deviation of the logarithms. A controller's own doings are as large as a gust."""
_FARTHEST = 4.0  # standard deviations
_STEP = 1e-3
_ITERATIONS, _ENOUGH = 20, 1e-3


@dataclass(frozen=True, eq=False)
class LoopNoise:
    """`w` (size,): the five sizes and times, standard normal a priori; `variance` (bin,) of coefficients [(m/s²)²].

    `value` [nats]: log density of the residual and of `w`; `information` (size, size) of `w`.
    """

    w: FloatArray
    variance: FloatArray = field(repr=False)
    value: float
    information: FloatArray = field(repr=False)

    @classmethod
    def of(cls, data: DriveData, residual: FloatArray, lag: float, start: FloatArray | None = None) -> LoopNoise:
        """The likeliest for a residual (frame, bin), `lag` [s] the actuator's; by scoring steps that gain."""
        energy, frames = (residual**2).sum(0), len(residual)
        w, damping = np.zeros(len(_PRIORS)) if start is None else start, 1e-2
        shape, value = _at(data, energy, frames, lag, w)
        information = np.eye(len(w))
        for _ in range(_ITERATIONS):
            ahead = [_log_variance(data, lag, w + step) for step in _STEP * np.eye(len(w))]
            slopes = (np.stack(ahead) - shape) / _STEP
            information = 0.5 * frames * slopes @ slopes.T + np.eye(len(w))
            gradient = 0.5 * slopes @ (energy * np.exp(-shape) - frames) - w
            gain = 0.0
            while damping < 1e6:
                step = np.linalg.solve(information + damping * np.diag(np.diag(information)), gradient)
                new = np.clip(w + np.clip(step, -1.0, 1.0), -_FARTHEST, _FARTHEST)
                tried, after = _at(data, energy, frames, lag, new)
                if after > value:
                    gain, w, shape, value, damping = after - value, new, tried, after, damping / 10
                    break
                damping *= 8
            if gain < _ENOUGH:
                break
        return cls(w, np.exp(shape), value, information)


def _at(data: DriveData, energy: FloatArray, frames: int, lag: float, w: FloatArray) -> tuple[FloatArray, float]:
    """Logarithm of the variance (bin,), and the log density [nats]."""
    shape = _log_variance(data, lag, w)
    nats = -0.5 * float((energy * np.exp(-shape) + frames * shape).sum())
    return shape, nats - 0.5 * float(w @ w)


def _log_variance(data: DriveData, lag: float, w: FloatArray) -> FloatArray:
    p, ratio, s, tau, r = np.exp(_PRIORS[:, 0] + _PRIORS[:, 1] * w)
    turn = 2 * np.pi * data.frequency
    gain = np.sinc(2 * data.frequency * data.dt)
    force = sum(2 * sd**2 * time / (1 + (turn * time) ** 2) for sd, time in ((p, ratio * lag), (s, tau)))
    return np.log(gain**2 * (force / data.dt + (turn * r) ** 2) + 1e-16)
