"""Sensor lag: the accelerometer's reading is low-pass filtered."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from avtorch.gap.simulator.effect import Effect, EffectContext, Parameter, register
from avtorch.gap.simulator.recursion import scan
from avtorch.vehicle.arguments import Number, tensor


@register
@dataclass(frozen=True)
class SensorLag(Effect):
    """First-order filter of time constant `lag_s` on the measured acceleration; neutral at 0.

    Exact for an acceleration that is linear between rows.

    Possible up to 1 s: an accelerometer responds within milliseconds, and no filter on a vehicle bus is slower.

    Example:
        >>> import torch
        >>> from avtorch.gap import SimulatorInput, SensorLag, plant
        >>> time = torch.arange(500, dtype=torch.float64) * 0.02
        >>> response = plant([SensorLag(0.16)]).response(SimulatorInput(time, torch.sin(time)))
        >>> rows = response.accel_measured[:300].argmax() - response.accel[:300].argmax()
        >>> round(0.02 * rows.item(), 2)  # s later than the car
        0.14
    """

    lag_s: Number = 0.16

    name = "sensor_lag"
    place = "sensor"
    meaning = "the accelerometer lags the car's acceleration"
    words = "the accelerometer lags by {lag_s:.2g} s"
    equation = "s' = (a - s) / lag"
    parameters = (Parameter("lag_s", "s", 0.0, 0.05, 0.5, possible=(0.0, 1.0)),)

    def start(self, x: Tensor, row: EffectContext) -> Any:
        return x, x, None

    def advance(self, x: Tensor, row: EffectContext, state: Any) -> tuple[Tensor, Any]:
        measured, before, dt = state
        if dt is not None:
            keep, old, new = self._weights(dt)
            measured = keep * measured + old * before + new * x
        return measured, (measured, x, row.dt)

    def over(self, x: Tensor, row: EffectContext) -> Tensor:
        dt = row.dt[..., :-1] if bool(row.dt.dim() and row.dt.min() != row.dt.max()) else row.dt.reshape(-1)[:1]
        keep, old, new = self._weights(dt)
        later = scan(keep, old * x[..., :-1] + new * x[..., 1:], x[..., 0])
        return torch.cat([x[..., :1].expand(*later.shape[:-1], 1), later], -1)

    def _weights(self, dt: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        lag = tensor(self.lag_s)
        ratio = dt / lag.clamp_min(1e-7 * dt)  # at a lag of 0 the filter has no memory, and still has a derivative
        keep = torch.exp(-ratio)
        held = lag / dt * -torch.expm1(-ratio)
        return keep, held - keep, 1 - held
