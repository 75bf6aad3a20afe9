"""The windows that every method gets, and the density that all of them sample, in NumPy.

A file of numbers, not of torch: a JAX peer's process must not carry two frameworks in its memory.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from avtorch.arrays import FloatArray

NAMES = ("T_L", "K_L", "sigma")
#: SPEC of the priors: ``log T_L``, ``log K_L`` normal with these medians and SDs, ``sigma`` half-normal [m/s^3].
MEDIAN, LOG_SD, SIGMA_SCALE = (0.3, 1.0), (0.7, 0.3), 1.0
RATE_HZ = 100.0


@dataclass(frozen=True)
class Windows:
    """Windows of measured jerk.

    Attributes:
        a, u, jerk: realised and demanded acceleration [m/s^2], jerk [m/s^3]; ``(window, time)``.
        truth: ``(T_L [s], K_L [-], sigma [m/s^3])`` that made them, ``(window, 3)``.
    """

    a: FloatArray
    u: FloatArray
    jerk: FloatArray
    truth: FloatArray

    def __len__(self) -> int:
        return len(self.a)

    def select(self, index: slice) -> Windows:
        return Windows(self.a[index], self.u[index], self.jerk[index], self.truth[index])

    def sums(self) -> FloatArray:
        """``(n, jj, aj, uj, aa, au, uu)`` of every window, ``(window, 7)``: all that Eq. 4 needs."""
        pairs = (
            (self.jerk, self.jerk),
            (self.a, self.jerk),
            (self.u, self.jerk),
            (self.a, self.a),
            (self.a, self.u),
            (self.u, self.u),
        )
        n = np.full(len(self), float(self.a.shape[1]))
        return np.stack([n, *(np.einsum("wt,wt->w", x, y) for x, y in pairs)], -1)

    def save(self, path: Path) -> None:
        np.savez(path, a=self.a, u=self.u, jerk=self.jerk, truth=self.truth)

    @classmethod
    def load(cls, path: Path) -> Windows:
        with np.load(path) as file:
            return cls(file["a"], file["u"], file["jerk"], file["truth"])


def make_windows(count: int, *, points: int = 200, seed: int = 0) -> Windows:
    """Windows at 100 Hz of different cars: T_L 0.1 to 2 s, K_L 0.4 to 1.1, sigma 0.05 to 0.3 m/s^3.

    The command is a sum of two sines of 0.1 to 1.5 m/s^2, so some windows are uninformative and their posteriors
    skewed.
    """
    g = np.random.default_rng(seed)
    lag = np.exp(g.uniform(np.log(0.1), np.log(2.0), count))
    gain = g.uniform(0.4, 1.1, count)
    sigma = np.exp(g.uniform(np.log(0.05), np.log(0.3), count))
    size = np.exp(g.uniform(np.log(0.1), np.log(1.5), count))
    frequency, phase = g.uniform([1.0, 3.0], [3.0, 8.0], (count, 2)), g.uniform(0, 2 * np.pi, (count, 2))
    time = np.arange(points) / RATE_HZ
    angle = frequency[:, :, None] * time + phase[:, :, None]
    u = size[:, None] * (np.sin(angle[:, 0]) + 0.5 * np.sin(angle[:, 1]))
    # exact for a command held over a step; the car has run on a constant command before the window
    decay = np.exp(-1 / (RATE_HZ * lag))
    a = np.empty_like(u)
    a[:, 0] = gain * u[:, 0] * g.uniform(-1, 1, count)
    for k in range(1, points):
        a[:, k] = decay * a[:, k - 1] + (1 - decay) * gain * u[:, k - 1]
    jerk = (gain[:, None] * u - a) / lag[:, None] + sigma[:, None] * g.standard_normal(u.shape)
    return Windows(a, u, jerk, np.stack([lag, gain, sigma], -1))
