"""The state of the latent form: speed, acceleration, an unknown force, and ``log T_L, log K_L``."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from avtorch.arrays import Float
from avtorch.inference.estimators.state_model import GaussianState, Observation
from avtorch.inference.latent_model import ACCEL_ROW, SPEED_ROW, Step, discretise, initial_covariance

_ROWS = {"speed": SPEED_ROW, "accel": ACCEL_ROW}


class LatentState:
    """``(v, a, c, e, log T_L, log K_L)``: the model of :mod:`avtorch.inference.latent_model`, parameters on a walk.

    With the parameters known and at rest the filter's log likelihood is that of the latent form, exactly.

    Args:
        measured: the channels, some of ``"accel"``, ``"speed"``.
        noise: the latent form's noise parameters by name; a filter takes them as given.
        drift: SD of the parameters' walk per square root of a second, of both logarithms.
        vehicles: how many. device: where their rows are.
    """

    def __init__(
        self,
        measured: tuple[str, ...],
        noise: Mapping[str, float],
        drift: float,
        vehicles: int,
        device: torch.device | str = "cpu",
    ) -> None:
        self.measured, self.drift = measured, drift
        self._noise = {name: torch.tensor(value, dtype=torch.float64, device=device) for name, value in noise.items()}
        variances = torch.stack([self._noise[f"{name}_noise"].square() for name in measured])
        self.variance = variances.expand(vehicles, -1)
        self._rows = [torch.tensor((*_ROWS[name], 0.0, 0.0), dtype=torch.float64, device=device) for name in measured]

    def start(self, actuation: GaussianState, row: Observation) -> GaussianState:
        vehicles = len(actuation.mean)
        mean, cov = actuation.mean.new_zeros(vehicles, 6), actuation.mean.new_zeros(vehicles, 6, 6)
        mean[:, 4:], cov[:, 4:, 4:] = actuation
        if "speed" in self.measured:
            mean[:, 0] = row.measured[:, self.measured.index("speed")]
        cov[:, :4, :4] = initial_covariance(self._noise["coloured_sd"], self._noise["coloured_time"])
        return GaussianState(mean, cov)

    def _step(self, x: Tensor, row: Observation) -> Step:
        n = self._noise
        road = n.get("road_noise", row.dt.new_zeros(()))
        parameters = (n["process_noise"], road, n["coloured_sd"], n["coloured_time"])
        return discretise(x[..., 4].exp(), x[..., 5].exp(), *parameters, row.dt)

    def advance(self, x: Float[Tensor, "*point vehicle 6"], row: Observation) -> Float[Tensor, "*point vehicle 6"]:
        step = self._step(x, row)
        moved = (step.transition @ x[..., :4, None])[..., 0] + step.gain * row.u[:, None]
        return torch.cat([moved, x[..., 4:]], -1)

    def slope(self, x: Float[Tensor, "*point vehicle 6"], row: Observation) -> Float[Tensor, "*point vehicle 6 6"]:
        step = self._step(x, row)
        a, K, u = x[..., 1], x[..., 5].exp(), row.u
        decay, reach = step.transition[..., 1, 1], step.transition[..., 0, 1]
        out = torch.diag_embed(torch.ones_like(x))
        out[..., :4, :4] = step.transition
        out[..., 0, 4] = (reach - decay * row.dt) * (a - K * u)
        out[..., 1, 4] = decay * row.dt * (-x[..., 4]).exp() * (a - K * u)
        out[..., :2, 5] = step.gain[..., :2] * u[:, None]
        return out

    def noise(self, x: Float[Tensor, "vehicle 6"], row: Observation) -> Float[Tensor, "vehicle 6 6"]:
        out = x.new_zeros(*x.shape, 6)
        out[..., :4, :4] = self._step(x, row).noise
        out[..., 4, 4] = out[..., 5, 5] = self.drift**2 * row.dt
        return out

    def observe(
        self, x: Float[Tensor, "*point vehicle 6"], row: Observation, channel: int
    ) -> Float[Tensor, "*point vehicle"]:
        return x @ self._rows[channel]

    def observed_slope(
        self, x: Float[Tensor, "*point vehicle 6"], row: Observation, channel: int
    ) -> Float[Tensor, "*point vehicle 6"]:
        return self._rows[channel].expand_as(x)
