r"""The joint extended Kalman filter (Jazwinski 1970): the model is replaced by its tangent at the mean.

.. math::
    \bar x = f(x),\quad \bar P = F P F^\top + Q, \qquad
    x^+ = \bar x + k\,(y - h(\bar x)),\quad P^+ = \bar P - k s k^\top,\quad
    s = H \bar P H^\top + r,\ k = \bar P H^\top / s
"""

from __future__ import annotations

import math

from torch import Tensor

from avtorch.arrays import Float
from avtorch.inference.estimators.kalman import JointKalman
from avtorch.inference.estimators.state_model import GaussianState, Observation, StateModel


class JointEKF(JointKalman):
    """One tangent a row: cheap, and overconfident where the belief is wide against the model's curvature.

    Example:
        >>> from avtorch import BeliefStream, GLVDPlant, Leader, simulate
        >>> run = simulate(Leader.default(start=50.0, duration=4.0, dt=0.02), plant=GLVDPlant(0.5, 0.9))
        >>> rows = {"accel": run.accel[:, 0], "accel_cmd": run.accel_cmd[:, 0], "jerk": run.jerk[:, 0]}
        >>> stream = BeliefStream(check_units=False, estimator="ekf", drift=0.02)  # made of JointEKF
        >>> [round(w.belief.stat("K_L")["mean"], 1) for w in stream.feed(run.time, rows) + stream.flush()]
        [0.9, 0.9]
    """

    def predict(self, model: StateModel, state: GaussianState, row: Observation) -> GaussianState:
        slope = model.slope(state.mean, row)
        cov = slope @ state.cov @ slope.mT + model.noise(state.mean, row)
        return GaussianState(model.advance(state.mean, row), cov)

    def correct(
        self, model: StateModel, state: GaussianState, row: Observation, channel: int
    ) -> tuple[GaussianState, Float[Tensor, " vehicle"]]:
        slope = model.observed_slope(state.mean, row, channel)
        pointing = (state.cov @ slope.unsqueeze(-1)).squeeze(-1)
        spread = (pointing * slope).sum(-1) + model.variance[:, channel]
        innovation = row.measured[:, channel] - model.observe(state.mean, row, channel)
        return gained(state, innovation, pointing, spread)


def gained(
    state: GaussianState,
    innovation: Float[Tensor, " vehicle"],
    pointing: Float[Tensor, "vehicle d"],
    spread: Float[Tensor, " vehicle"],
) -> tuple[GaussianState, Float[Tensor, " vehicle"]]:
    """The linear update: ``pointing`` ``(vehicle, d)`` is the covariance of state and reading, ``spread`` its variance.

    Returns the state and the log likelihood of the reading, ``(vehicle,)``.
    """
    gain = pointing / spread.unsqueeze(-1)
    mean = state.mean + gain * innovation.unsqueeze(-1)
    cov = state.cov - gain.unsqueeze(-1) * pointing.unsqueeze(-2)
    likelihood = -0.5 * (spread.log() + innovation.square() / spread + math.log(2 * math.pi))
    return GaussianState(mean, 0.5 * (cov + cov.mT)), likelihood
