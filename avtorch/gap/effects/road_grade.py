"""Road grade: an unknown, smooth grade along the road."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Self

import torch
from torch import Tensor

from avtorch.gap.simulator.effect import Domain, Effect, EffectContext, Parameter, register
from avtorch.io.units import GRAVITY
from avtorch.vehicle.arguments import Number, tensor


@register
@dataclass(frozen=True)
class RoadGrade(Effect):
    """`-g sin(slope(position))`; the grade is a Gaussian process over position of RMS `grade_rms`; neutral at 0.

    Its correlation (Matern 3/2) has the length `smooth_m` [m]. It is expanded in cubic B-splines, one every `knot_m`
    [m]; `profile` (knots,) holds their coefficients, with independent standard normal priors (the correlation is
    included in the basis). The response is linear in them as far as the sine is, so a likelihood can integrate them out
    by the `columns`. Where `profile` is None the grade is 0, or drawn where drives are sampled.

    Possible up to 0.2 over a drive: the steepest streets reach 0.35.

    Example:
        >>> import torch
        >>> from avtorch.gap import SimulatorInput, RoadGrade, plant
        >>> time = torch.arange(1000, dtype=torch.float64) * 0.1
        >>> drive = SimulatorInput(time, 0 * time, speed=torch.full_like(time, 20.0))  # 2 km of road
        >>> hilly = plant([RoadGrade(grade_rms=0.03)]).prepared(drive)
        >>> accel = hilly.response(drive, generator=torch.Generator().manual_seed(0)).accel
        >>> bool(accel.abs().max() > 0.2)  # a slope of 3 % pulls with 0.3 m/s²
        True
    """

    grade_rms: Number = 0.03
    profile: Tensor | None = None
    knots: int = 256
    knot_m: float = 80.0
    smooth_m: float = 180.0

    name = "road_grade"
    place = "body"
    needs_speed = True
    gravity = True
    meaning = "a road grade that the log does not record"
    equation = "-g sin(slope(x)), slope a smooth random function of position"
    of_the_drive = True
    parameters = (Parameter("grade_rms", "-", 0.0, 0.02, 0.06, possible=(0.0, 0.2)),)
    settings = (
        Domain("profile", -100.0, 100.0, least=4, most=4096),
        Domain("knots", 4, 4096, whole=True),
        Domain("knot_m", 10.0, 10_000.0, "m"),
        Domain("smooth_m", 10.0, 30_000.0, "m"),
    )

    @classmethod
    def in_words(cls, values: Mapping[str, float]) -> str:
        return f"the road has slopes of {100 * values['grade_rms']:.2g} % RMS that the log does not record"

    def apply(self, x: Tensor, row: EffectContext) -> Tensor:
        position = row.position
        if self.profile is None:
            return torch.zeros_like(position)
        lower = _lower(len(self.profile), self.knot_m, self.smooth_m)
        slope = tensor(self.grade_rms) * _spline(position, lower @ tensor(self.profile), self.knot_m)
        return -GRAVITY * slope * torch.rsqrt(1 + slope * slope)  # sin(atan(slope)), at a third of its cost

    def prepared(self, time: Tensor, speed: Tensor | None, position: Tensor | None) -> Self:
        if position is None:
            return self
        return replace(self, knots=int(float(position.max()) / self.knot_m) + 4, profile=None)

    def drawn(self, generator: torch.Generator | None) -> Self:
        if self.profile is not None:
            return self
        return replace(self, profile=torch.randn(self.knots, generator=generator, dtype=torch.float64))

    def columns(self, position: Tensor) -> Tensor:
        """Acceleration (time, knot) per unit of each coefficient at `grade_rms` 1, `position` (time,) [m]."""
        lower = _lower(self.knots, self.knot_m, self.smooth_m)
        return -GRAVITY * torch.stack([_spline(position, column, self.knot_m) for column in lower.T], -1)


def _spline(position: Tensor, coefficients: Tensor, knot: float) -> Tensor:
    """Cubic B-spline with `coefficients` (knot,) at `position` (...)."""
    at = position / knot
    cell = at.detach().floor().clamp(0, len(coefficients) - 4)
    t = at - cell
    weights = ((1 - t) ** 3, 3 * t**3 - 6 * t**2 + 4, -3 * t**3 + 3 * t**2 + 3 * t + 1, t**3)
    values = (coefficients[cell.long() + j] for j in range(4))
    return torch.stack([weight / 6 * value for weight, value in zip(weights, values, strict=True)]).sum(0)


@lru_cache(maxsize=16)
def _lower(knots: int, knot: float, smooth: float) -> Tensor:
    """Cholesky factor of the coefficients' prior, scaled so that the grade has standard deviation 1 at mid-cell."""
    away = math.sqrt(3) * knot / smooth * (torch.arange(knots)[:, None] - torch.arange(knots)).abs().double()
    covariance = (1 + away) * torch.exp(-away)
    middle = torch.tensor([1.0, 23.0, 23.0, 1.0], dtype=torch.float64) / 48
    size = middle @ covariance[:4, :4] @ middle
    return torch.linalg.cholesky(covariance / size)
