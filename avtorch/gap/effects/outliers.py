"""Outliers: occasional large errors of the accelerometer."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Self

import torch
from torch import Tensor

from avtorch.gap.simulator.effect import Domain, Effect, EffectContext, NoiseChange, Parameter, register
from avtorch.vehicle.arguments import Number, tensor


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
