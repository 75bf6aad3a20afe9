"""Speed lag: the speed's reading is low-pass filtered."""

from __future__ import annotations

from dataclasses import dataclass

from avtorch.gap.effects.sensor_lag import SensorLag
from avtorch.gap.simulator.effect import Parameter, register
from avtorch.vehicle.arguments import Number


@register
@dataclass(frozen=True)
class SpeedSensorLag(SensorLag):
    """First-order filter of time constant `lag_s` on the measured speed; neutral at 0.

    Beyond what recorders do to a speed, some 30 ms. Possible up to 2 s: a filter or observer on the wheel speed, or a
    receiver of satellites.

    Example:
        >>> import torch
        >>> from avtorch.gap import SimulatorInput, SpeedSensorLag, plant
        >>> time = torch.arange(500, dtype=torch.float64) * 0.02
        >>> braking = SimulatorInput(time, torch.full_like(time, -1.0), torch.full_like(time, 20.0))
        >>> response = plant([SpeedSensorLag(0.3)]).response(braking)
        >>> round((response.speed_measured - response.speed)[-1].item(), 2)  # m/s, 0.3 s of a deceleration of 1 m/s²
        0.3
    """

    lag_s: Number = 0.4

    name = "speed_lag"
    reading = "speed"
    needs_speed = True
    meaning = "the measured speed lags the car's"
    words = "the measured speed lags by {lag_s:.2g} s"
    equation = "s' = (v - s) / lag"
    parameters = (Parameter("lag_s", "s", 0.0, 0.25, 0.8, possible=(0.0, 2.0)),)
