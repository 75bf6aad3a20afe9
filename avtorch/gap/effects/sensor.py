"""Effects of the sensors, which the car itself does not feel."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Self

import torch
from torch import Tensor

from avtorch.gap.simulator.effect import Domain, Effect, EffectContext, NoiseChange, Parameter, register
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
    equation = "s' = (a - s) / lag"
    parameters = (Parameter("lag_s", "s", 0.0, 0.05, 0.5, possible=(0.0, 1.0)),)

    @classmethod
    def in_words(cls, values: Mapping[str, float]) -> str:
        return f"the accelerometer lags by {values['lag_s']:.2g} s"

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
    equation = "s' = (v - s) / lag"
    parameters = (Parameter("lag_s", "s", 0.0, 0.25, 0.8, possible=(0.0, 2.0)),)

    @classmethod
    def in_words(cls, values: Mapping[str, float]) -> str:
        return f"the measured speed lags by {values['lag_s']:.2g} s"


@register
@dataclass(frozen=True)
class SensorScale(Effect):
    """The measured acceleration times `scale`; neutral at 1.

    A speed that reads 1 / `scale` of the truth (a wheel's radius) beside a right accelerometer is the same log, of a
    car whose gain is K_L times `scale`. Possible are half to twice the true value; beyond that the unit is wrong.

    Example:
        >>> import torch
        >>> from avtorch.gap import SimulatorInput, SensorScale, plant
        >>> time = torch.arange(100, dtype=torch.float64) * 0.05
        >>> response = plant([SensorScale(1.12)]).response(SimulatorInput(time, torch.sin(time)))
        >>> bool(torch.allclose(response.accel_measured, 1.12 * response.accel))
        True
    """

    scale: Number = 1.12

    name = "sensor_scale"
    place = "sensor"
    order = 1
    meaning = "the accelerometer's gain is wrong"
    equation = "scale a"
    parameters = (Parameter("scale", "-", 1.0, 0.83, 1.2, possible=(0.5, 2.0)),)

    @classmethod
    def in_words(cls, values: Mapping[str, float]) -> str:
        scale = values["scale"]
        more = "more" if scale > 1 else "less"
        return f"the accelerometer shows {abs(100 * (scale - 1)):.2g} % {more} than the speed: one scale is wrong"

    def apply(self, x: Tensor, row: EffectContext) -> Tensor:
        return tensor(self.scale) * x


@register
@dataclass(frozen=True)
class SensorBias(Effect):
    """`bias_mps2` on top of the measured acceleration; neutral at 0.

    Possible up to 1 m/s² either way, an accelerometer that is tilted by 6 degrees.

    Example:
        >>> import torch
        >>> from avtorch.gap import SimulatorInput, SensorBias, plant
        >>> time = torch.arange(100, dtype=torch.float64) * 0.05
        >>> response = plant([SensorBias(0.12)]).response(SimulatorInput(time, torch.sin(time)))
        >>> bool(torch.allclose(response.accel_measured, response.accel + 0.12))
        True
    """

    bias_mps2: Number = 0.12

    name = "sensor_bias"
    place = "sensor"
    order = 2
    meaning = "the accelerometer has a constant offset"
    equation = "a + b"
    parameters = (Parameter("bias_mps2", "m/s²", 0.0, -0.25, 0.25, "real", possible=(-1.0, 1.0)),)

    @classmethod
    def in_words(cls, values: Mapping[str, float]) -> str:
        bias = values["bias_mps2"]
        return f"the accelerometer reads {abs(bias):.2g} m/s² too {'high' if bias > 0 else 'low'}"

    def apply(self, x: Tensor, row: EffectContext) -> Tensor:
        return x + tensor(self.bias_mps2)


@register
@dataclass(frozen=True)
class Outliers(Effect):
    """A `fraction` of samples has a normal error of `scale` times `noise_sd` [m/s²]; neutral at fraction 0.

    Random: its deterministic response is zero; the accelerometer's noise gains heavy tails, in units of its own
    standard deviation. `noise_sd` is used in simulation only.

    Possible up to 0.3 of the samples, beyond which they are the noise's own distribution and not outliers; scale 2 or
    more.

    Example:
        >>> import torch
        >>> from avtorch.gap import SimulatorInput, Outliers, plant
        >>> time = torch.arange(2000, dtype=torch.float64) * 0.05
        >>> car = plant([Outliers(fraction=0.02, noise_sd=0.05)])
        >>> parked = SimulatorInput(time, 0 * time)
        >>> seen = car.response(parked, generator=torch.Generator().manual_seed(0)).accel_measured
        >>> round((seen.abs() > 0.05).double().mean().item(), 2)
        0.02
    """

    fraction: Number = 0.016
    scale: Number = 7.0
    noise_sd: float = 0.05

    name = "outliers"
    place = "sensor"
    order = 9
    meaning = "single samples of the accelerometer are far off"
    equation = "a + scale sigma e, with probability fraction"
    parameters = (
        Parameter("fraction", "-", 0.0, 0.005, 0.05, "unit", possible=(0.0, 0.3)),
        Parameter("scale", "sigma", None, 5.0, 10.0, possible=(2.0, 1000.0)),
    )
    settings = (Domain("noise_sd", 0.0, 100.0, "m/s²"),)

    @classmethod
    def in_words(cls, values: Mapping[str, float]) -> str:
        return f"{100 * values['fraction']:.2g} % of the accelerometer's samples are far off"

    def apply(self, x: Tensor, row: EffectContext) -> Tensor:
        if row.normal is None:
            return x
        # one draw serves both: within the tail fraction it is uniform again
        level = torch.special.ndtr(row.normal)
        fraction = tensor(self.fraction)
        hit = level < fraction
        again = torch.where(hit, level / torch.where(hit, fraction, 1.0), 0.5)
        error = torch.special.ndtri(again.clamp(1e-12, 1 - 1e-12))
        return x + torch.where(hit, tensor(self.scale) * self.noise_sd * error, 0.0)

    def in_noise(self, accel_sd: float) -> Self:
        return replace(self, noise_sd=accel_sd)

    def noise(self, u: Tensor) -> NoiseChange:
        return NoiseChange(tail_fraction=tensor(self.fraction), tail_scale=tensor(self.scale))
