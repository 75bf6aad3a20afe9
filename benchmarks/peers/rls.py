"""Recursive least squares on ``(1/T_L, K_L/T_L)``, row by row, and the delta method for ``(T_L, K_L)``.

It works on Eq. 4 without the priors, except for a wide start; ``sigma`` is the residual's SD and gets no posterior.
"""

from __future__ import annotations

import numpy as np

from avtorch.arrays import FloatArray
from benchmarks.peers.contract import Answer, Settings
from benchmarks.peers.problem import Windows


class Runner:
    def __init__(self, settings: Settings) -> None: ...

    def log_density(self, windows: Windows, z: FloatArray) -> None:
        return None

    def run(self, windows: Windows, seed: int) -> Answer:
        rows = np.stack([-windows.a, windows.u], -1)  # (window, time, 2); all windows take each row together
        beta = np.zeros((len(windows), 2))
        cov = np.tile(1e4 * np.eye(2), (len(windows), 1, 1))  # in units of sigma^2
        squares = np.zeros(len(windows))
        for k in range(rows.shape[1]):
            x = rows[:, k]
            spread = np.einsum("wij,wj->wi", cov, x)
            innovation = windows.jerk[:, k] - (beta * x).sum(-1)
            total = 1 + (spread * x).sum(-1)
            beta = beta + spread * (innovation / total)[:, None]
            cov = cov - spread[:, :, None] * spread[:, None, :] / total[:, None, None]
            squares += innovation**2 / total
        sigma2 = squares / max(rows.shape[1] - 2, 1)
        b, g = beta.T
        lag, gain = 1 / b, g / b
        # derivatives of 1/b and g/b
        slope_lag, slope_gain = np.stack([-(lag**2), 0 * lag], -1), np.stack([-gain * lag, lag], -1)
        variance = [np.einsum("wi,wij,wj->w", s, cov, s) * sigma2 for s in (slope_lag, slope_gain)]
        nothing = np.full(len(windows), np.nan)
        return Answer(
            mean=np.stack([lag, gain, nothing], -1),
            sd=np.stack([np.sqrt(variance[0]), np.sqrt(variance[1]), nothing], -1),
        )
