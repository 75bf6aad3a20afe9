"""The state of the jerk form: acceleration is known, so only ``(log T_L, log K_L)`` is filtered."""

from __future__ import annotations

import torch
from torch import Tensor

from avtorch.arrays import Float
from avtorch.inference.estimators.state_model import GaussianState, Observation


class JerkState:
    """``(log T_L, log K_L)`` as a random walk, observed through Eq. 1: ``jerk = (K_L u - a)/T_L + N(0, sigma^2)``.

    Args:
        sigma: jerk noise [m/s³], ``(vehicle,)``.
        drift: SD of the walk per square root of a second, of both logarithms.
    """

    def __init__(self, sigma: Float[Tensor, " vehicle"], drift: float) -> None:
        self.variance = sigma.square().unsqueeze(-1)
        self._walk = drift**2 * torch.eye(2, dtype=sigma.dtype, device=sigma.device)
        self._still = torch.eye(2, dtype=sigma.dtype, device=sigma.device)

    def start(self, actuation: GaussianState, row: Observation) -> GaussianState:
        return actuation

    def advance(self, x: Float[Tensor, "*point vehicle 2"], row: Observation) -> Float[Tensor, "*point vehicle 2"]:
        return x

    def slope(self, x: Float[Tensor, "*point vehicle 2"], row: Observation) -> Float[Tensor, "*point vehicle 2 2"]:
        return self._still.expand(*x.shape, 2)

    def noise(self, x: Float[Tensor, "vehicle 2"], row: Observation) -> Float[Tensor, "2 2"]:
        return row.dt * self._walk

    def observe(
        self, x: Float[Tensor, "*point vehicle 2"], row: Observation, channel: int
    ) -> Float[Tensor, "*point vehicle"]:
        log_T, log_K = x.unbind(-1)
        return (log_K.exp() * row.u - row.a) * (-log_T).exp()

    def observed_slope(
        self, x: Float[Tensor, "*point vehicle 2"], row: Observation, channel: int
    ) -> Float[Tensor, "*point vehicle 2"]:
        by_gain = (x[..., 1] - x[..., 0]).exp() * row.u
        return torch.stack([(-x[..., 0]).exp() * row.a - by_gain, by_gain], -1)
