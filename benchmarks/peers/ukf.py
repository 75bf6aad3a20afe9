"""Unscented Kalman filter over the constant state ``(log T_L, log K_L)``: every row's jerk is one observation of it.

The filter is that of ``filterpy``. It starts from the prior; its noise is the residual's SD of a least-squares fit, so
``sigma`` gets no posterior. The moments of ``(T_L, K_L)`` are those of the log-normal.
"""

from __future__ import annotations

import numpy as np
from filterpy.kalman import MerweScaledSigmaPoints, UnscentedKalmanFilter

from benchmarks.peers.contract import Answer, Settings
from benchmarks.peers.problem import LOG_SD, MEDIAN, FloatArray, Windows


class Runner:
    def __init__(self, settings: Settings) -> None: ...

    def log_density(self, windows: Windows, z: FloatArray) -> None:
        return None

    def run(self, windows: Windows, seed: int) -> Answer:
        a, u, jerk = windows.a[0], windows.u[0], windows.jerk[0]
        design = np.stack([-a, u], -1)
        residual = jerk - design @ np.linalg.lstsq(design, jerk)[0]
        points = MerweScaledSigmaPoints(2, alpha=0.5, beta=2.0, kappa=1.0)

        def observed(x: FloatArray, a: float, u: float) -> FloatArray:
            lag, gain = np.exp(x)
            return np.array([(gain * u - a) / lag])

        kalman = UnscentedKalmanFilter(2, 1, 1.0, observed, lambda x, dt: x, points)
        kalman.x, kalman.P = np.log(MEDIAN), np.diag(np.square(LOG_SD))
        kalman.Q, kalman.R = np.zeros((2, 2)), np.array([[residual.var()]])
        for k in range(len(jerk)):
            kalman.predict()
            kalman.update(jerk[k : k + 1], a=a[k], u=u[k])
        variance = np.diag(kalman.P)
        mean = np.exp(kalman.x + 0.5 * variance)
        sd = mean * np.sqrt(np.expm1(variance))
        return Answer(mean=np.append(mean, np.nan)[None], sd=np.append(sd, np.nan)[None])
