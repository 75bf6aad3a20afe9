r"""The joint unscented Kalman filter (Julier and Uhlmann 1997) with ``kappa = 0``: 2d points of equal weight.

The points :math:`x \pm \sqrt{d}\, L_i`, ``L`` the Cholesky factor of the covariance, pass the model itself; mean and
covariance of the transformed points are the prediction. Positive weights keep every covariance positive, and there is
no tuning parameter.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from avtorch.arrays import Float
from avtorch.inference.estimators.ekf import gained
from avtorch.inference.estimators.kalman import JointKalman
from avtorch.inference.estimators.state_model import GaussianState, Observation, StateModel


class JointUKF(JointKalman):
    """Second order in the mean and no derivatives, at ``2d`` runs of the model a row.

    Example:
        >>> from avtorch import BeliefStream, GLVDPlant, Leader, simulate
        >>> run = simulate(Leader.default(start=50.0, duration=4.0, dt=0.02), plant=GLVDPlant(0.5, 0.9))
        >>> rows = {"accel": run.accel[:, 0], "accel_cmd": run.accel_cmd[:, 0], "jerk": run.jerk[:, 0]}
        >>> stream = BeliefStream(check_units=False, estimator="ukf", drift=0.02)  # made of JointUKF
        >>> [round(w.belief.stat("K_L")["mean"], 1) for w in stream.feed(run.time, rows) + stream.flush()]
        [0.9, 0.9]
    """

    def predict(self, model: StateModel, state: GaussianState, row: Observation) -> GaussianState:
        points = model.advance(sigma_points(state), row)
        mean = points.mean(0)
        centred = points - mean
        cov = torch.einsum("pvi,pvj->vij", centred, centred) / len(points) + model.noise(state.mean, row)
        return GaussianState(mean, cov)

    def correct(
        self, model: StateModel, state: GaussianState, row: Observation, channel: int
    ) -> tuple[GaussianState, Float[Tensor, " vehicle"]]:
        points = sigma_points(state)
        seen = model.observe(points, row, channel)
        expected = seen.mean(0)
        off = seen - expected
        pointing = ((points - state.mean) * off.unsqueeze(-1)).mean(0)
        spread = off.square().mean(0) + model.variance[:, channel]
        return gained(state, row.measured[:, channel] - expected, pointing, spread)


def sigma_points(state: GaussianState) -> Float[Tensor, "point vehicle d"]:
    """``(2d, vehicle, d)``; not a number where the covariance has no Cholesky factor: the filter has diverged."""
    root, failed = torch.linalg.cholesky_ex(state.cov)
    root = torch.where((failed == 0)[:, None, None], root, torch.nan)
    reach = math.sqrt(state.mean.shape[-1]) * root.movedim(-1, 0)
    return torch.cat([state.mean + reach, state.mean - reach])
