"""Forces on the body besides the actuator's."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, Self

import numpy as np
import torch
from torch import Tensor

from avtorch.gap.simulator.actuator import modes_over
from avtorch.gap.simulator.effect import Domain, Effect, EffectContext, NoiseChange, Parameter, register
from avtorch.gap.simulator.recursion import scan, scan_pair
from avtorch.io.units import GRAVITY
from avtorch.vehicle.arguments import Number, tensor

_FAST = 30.0
"""Speed [m/s] at which its size is told."""


@register
@dataclass(frozen=True)
class AerodynamicDrag(Effect):
    """`-drag_per_m (v + wind_mps)²`: drag against the relative wind; neutral at 0. The head wind is fitted with it.

    Possible up to 3e-3 1/m, the value of a cyclist; a car has 2 to 6e-4 (half of rho c_d A / m).

    Example:
        >>> import torch
        >>> from avtorch.gap import AerodynamicDrag, SimulatorInput, plant
        >>> time = torch.arange(200, dtype=torch.float64) * 0.05
        >>> coasting = SimulatorInput(time, 0 * time, speed=torch.full_like(time, 30.0))
        >>> accel = plant([AerodynamicDrag(4e-4)]).response(coasting).accel
        >>> round(accel[-1].item(), 2)  # 4e-4 times 30²
        -0.36
    """

    drag_per_m: Number = 3.5e-4
    wind_mps: Number = 0.0

    name = "aerodynamic_drag"
    place = "body"
    needs_speed = True
    meaning = "air resistance that the lower level does not compensate"
    equation = "-c (v + w)²"
    parameters = (
        Parameter("drag_per_m", "1/m", 0.0, 2e-4, 6e-4, possible=(0.0, 3e-3)),
        Parameter("wind_mps", "m/s", None, -4.0, 4.0, "real", reported=False),
    )

    @classmethod
    def in_words(cls, values: Mapping[str, float]) -> str:
        force = values["drag_per_m"] * _FAST**2
        return f"air resistance slows the car by {force:.2g} m/s² at {_FAST:.0f} m/s"

    def apply(self, x: Tensor, row: EffectContext) -> Tensor:
        air = row.speed + tensor(self.wind_mps)
        return -tensor(self.drag_per_m) * air * air.abs()


@register
@dataclass(frozen=True)
class ViscousDrag(Effect):
    """`-drag_per_s v`: bearings, oil, a motor's back electromotive force; neutral at 0.

    Possible up to 1 1/s, a small robot whose motor is shorted; a car's driveline has some 0.005.

    Example:
        >>> import torch
        >>> from avtorch.gap import SimulatorInput, ViscousDrag, plant
        >>> time = torch.arange(200, dtype=torch.float64) * 0.05
        >>> coasting = SimulatorInput(time, 0 * time, speed=torch.full_like(time, 20.0))
        >>> accel = plant([ViscousDrag(0.01)]).response(coasting).accel
        >>> round(accel[-1].item(), 2)  # m/s²
        -0.2
    """

    drag_per_s: Number = 0.012

    name = "viscous_drag"
    place = "body"
    needs_speed = True
    meaning = "a resistance in proportion to the speed"
    equation = "-c v"
    parameters = (Parameter("drag_per_s", "1/s", 0.0, 0.004, 0.03, possible=(0.0, 1.0)),)

    @classmethod
    def in_words(cls, values: Mapping[str, float]) -> str:
        return f"a drag in proportion to the speed slows the car by {10 * values['drag_per_s']:.2g} m/s² at 10 m/s"

    def apply(self, x: Tensor, row: EffectContext) -> Tensor:
        return -tensor(self.drag_per_s) * row.speed


@register
@dataclass(frozen=True)
class ConstantResistance(Effect):
    """`-resistance_mps2` while the car moves, always where no speed was measured; neutral at 0.

    Possible up to 3.5 m/s²: loose sand, or a motor that brakes as soon as the pedal is released.

    Example:
        >>> import torch
        >>> from avtorch.gap import ConstantResistance, SimulatorInput, plant
        >>> time = torch.arange(100, dtype=torch.float64) * 0.05
        >>> rolling = SimulatorInput(time, 0 * time, speed=torch.full_like(time, 10.0))
        >>> plant([ConstantResistance(0.12)]).response(rolling).accel[-1].item()
        -0.12
    """

    resistance_mps2: Number = 0.12

    name = "constant_resistance"
    place = "body"
    meaning = "the same deceleration at every speed"
    equation = "-r while moving"
    parameters = (Parameter("resistance_mps2", "m/s²", 0.0, 0.05, 0.3, possible=(0.0, 3.5)),)

    @classmethod
    def in_words(cls, values: Mapping[str, float]) -> str:
        return f"the car is slowed by {values['resistance_mps2']:.2g} m/s² at every speed"

    def apply(self, x: Tensor, row: EffectContext) -> Tensor:
        force = -tensor(self.resistance_mps2)
        if row.measured_speed is None:
            return force * torch.ones_like(x)
        return torch.where(row.speed > 0, force, 0.0)


_FADES_AT = 3.0  # [m/s]
_FADES_OVER = 0.5  # [m/s]


@register
@dataclass(frozen=True)
class LowSpeedCreep(Effect):
    """`creep_mps2` below about 3 m/s, fading smoothly there; neutral at 0.

    Possible up to 1.5 m/s²: the full stall torque of a converter.

    Example:
        >>> import torch
        >>> from avtorch.gap import SimulatorInput, LowSpeedCreep, plant
        >>> time = torch.arange(100, dtype=torch.float64) * 0.05
        >>> speed = torch.tensor([[0.5], [20.0]], dtype=torch.float64).expand(2, 100)
        >>> accel = plant([LowSpeedCreep(0.22)]).response(SimulatorInput(time, 0 * speed, speed=speed)).accel
        >>> accel[:, -1].round(decimals=1).tolist()
        [0.2, 0.0]
    """

    creep_mps2: Number = 0.22

    name = "low_speed_creep"
    place = "body"
    needs_speed = True
    meaning = "the car is pushed forward at walking speed"
    equation = "creep / (1 + exp((v - 3) / 0.5))"
    parameters = (Parameter("creep_mps2", "m/s²", 0.0, 0.1, 0.5, possible=(0.0, 1.5)),)

    @classmethod
    def in_words(cls, values: Mapping[str, float]) -> str:
        return f"the car is pushed forward by {values['creep_mps2']:.2g} m/s² at walking speed"

    def apply(self, x: Tensor, row: EffectContext) -> Tensor:
        return tensor(self.creep_mps2) * torch.sigmoid((_FADES_AT - row.speed) / _FADES_OVER)


@register
@dataclass(frozen=True)
class DrivelineOscillation(Effect):
    """A mode of the driveline that the actuator's jerk `j` excites; neutral at amplitude and quadrature 0.

    `y'' + 2 zeta omega y' + omega² y = omega j`; the car gains `amplitude y + quadrature y' / omega` [m/s²].

    A step of the actuator by 1 m/s² rings with `amplitude` [m/s²]. The phase depends on where the mode sits in the
    driveline, so a quadrature part is fitted too; the answer states the length of both. Each step holds its mean jerk,
    and the mode is integrated exactly at any damping (above 1 it decays without ringing).

    Possible are 0.3 to 15 Hz (driveline shuffle, from trucks to small cars), and a ring of twice the step at most.

    Example:
        >>> import torch
        >>> from avtorch.gap import SimulatorInput, DrivelineOscillation, plant
        >>> time = torch.arange(400, dtype=torch.float64) * 0.01
        >>> step = SimulatorInput(time, (time >= 1.0).double())
        >>> accel = plant([DrivelineOscillation(frequency_hz=2.2, amplitude=0.3)], T_L=0.1).response(step).accel
        >>> round(accel.max().item(), 1)  # the step of 1 m/s² rings
        1.1
    """

    frequency_hz: Number = 2.2
    amplitude: Number = 0.3
    quadrature: Number = 0.0
    mode_damping: Number = 0.08

    name = "driveline_oscillation"
    place = "body"
    meaning = "changes of the drive torque make the driveline ring"
    equation = "amplitude y,  y'' + 2 zeta omega y' + omega² y = omega da/dt"
    parameters = (
        Parameter("frequency_hz", "Hz", None, 1.0, 5.0, possible=(0.3, 15.0)),
        Parameter("amplitude", "-", 0.0, -0.5, 0.5, "real", possible=(-2.0, 2.0)),
        Parameter("quadrature", "-", 0.0, -0.5, 0.5, "real", reported=False, possible=(-1.0, 1.0)),
        Parameter("mode_damping", "-", None, 0.03, 0.2, reported=False, possible=(0.005, 0.35)),
    )

    @classmethod
    def in_words(cls, values: Mapping[str, float]) -> str:
        return f"the driveline rings at {values['frequency_hz']:.2g} Hz"

    def report(self, T_L: Tensor) -> dict[str, Tensor]:
        amplitude = torch.hypot(tensor(self.amplitude), tensor(self.quadrature))
        return {"frequency_hz": tensor(self.frequency_hz), "amplitude": amplitude}

    def start(self, x: Tensor, row: EffectContext) -> Any:
        zero = torch.zeros_like(x)
        return x, zero, zero, None

    def advance(self, x: Tensor, row: EffectContext, state: Any) -> tuple[Tensor, Any]:
        before, y, rate, dt = state
        if dt is not None:  # from the previous row to this one
            (m00, m01, m10, m11), (b0, b1) = self._step(dt)
            jerk = (x - before) / dt
            y, rate = m00 * y + m01 * rate + b0 * jerk, m10 * y + m11 * rate + b1 * jerk
        return self._seen(y, rate), (x, y, rate, row.dt)

    def over(self, x: Tensor, row: EffectContext) -> Tensor:
        dt = row.dt[..., :-1] if bool(row.dt.dim() and row.dt.min() != row.dt.max()) else row.dt.reshape(-1)[:1]
        matrix, (b0, b1) = self._step(dt)
        jerk = x.diff(dim=-1) / dt
        zero = torch.zeros((), dtype=x.dtype)
        y, rate = scan_pair(matrix, (b0 * jerk, b1 * jerk), (zero, zero))
        first = torch.zeros_like(y[..., :1])
        return self._seen(torch.cat([first, y], -1), torch.cat([first, rate], -1))

    def _seen(self, y: Tensor, rate: Tensor) -> Tensor:
        return tensor(self.amplitude) * y + tensor(self.quadrature) * rate

    def _step(self, dt: Tensor) -> tuple[tuple[Tensor, Tensor, Tensor, Tensor], tuple[Tensor, Tensor]]:
        """State `(y, y' / omega)` after `dt`, and the contribution of a constant jerk."""
        omega, zeta = 2 * math.pi * tensor(self.frequency_hz), tensor(self.mode_damping)
        # the actuator's formulas, valid at any damping: their second component is y' / omega²
        m00, m01, m10, m11 = modes_over(1 / omega, 2 * zeta / omega, dt)
        matrix = (m00, m01 / omega, omega * m10, m11)
        # a constant jerk has the equilibrium jerk / omega, which the state approaches
        return matrix, ((1 - matrix[0]) / omega, -matrix[2] / omega)


@register
@dataclass(frozen=True)
class RoadGrade(Effect):
    """`-g sin(slope(position))`; the grade is a Gaussian process over position of RMS `grade_rms`; neutral at 0.

    Its correlation (Matern 3/2) has the length `smooth_m` [m]. It is expanded in cubic B-splines, one every `knot_m`
    [m]; `profile` (..., knots) holds their coefficients, with independent standard normal priors (the correlation is
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
        slope = tensor(self.grade_rms) * _spline(position, self._coefficients(), self.knot_m, row.whole)
        return -GRAVITY * slope * torch.rsqrt(1 + slope * slope)  # sin(atan(slope)), at a third of its cost

    def coordinates(self) -> tuple[Parameter, ...]:
        return *self.parameters, Parameter("profile", "-", None, -1.2816, 1.2816, "real", False, self.knots)

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
        return -GRAVITY * _spline(position, lower.T, self.knot_m, True).movedim(0, -1)

    def _coefficients(self) -> Tensor:
        profile = tensor(self.profile)
        return profile @ _lower(profile.shape[-1], self.knot_m, self.smooth_m).T


def _spline(position: Tensor, coefficients: Tensor, knot: float, whole: bool) -> Tensor:
    """Cubic B-spline with `coefficients` (..., knot) at `position`: (..., time), or (...) where not `whole`."""
    at = position / knot
    cell = at.detach().floor().clamp(0, coefficients.shape[-1] - 4)
    t = at - cell
    weights = ((1 - t) ** 3, 3 * t**3 - 6 * t**2 + 4, -3 * t**3 + 3 * t**2 + 3 * t + 1, t**3)
    total = torch.zeros((), dtype=position.dtype)
    for j, weight in enumerate(weights):
        index = cell.long() + j
        if coefficients.dim() == 1:
            value = coefficients[index]
        else:
            index = index if whole else index[..., None]
            shape = np.broadcast_shapes(index.shape[:-1], coefficients.shape[:-1])
            value = coefficients.expand(*shape, -1).gather(-1, index.expand(*shape, -1))
            value = value if whole else value[..., 0]
        total = total + weight / 6 * value
    return total


@lru_cache(maxsize=16)
def _lower(knots: int, knot: float, smooth: float) -> Tensor:
    """Cholesky factor of the coefficients' prior, scaled so that the grade has standard deviation 1 at mid-cell."""
    away = math.sqrt(3) * knot / smooth * (torch.arange(knots)[:, None] - torch.arange(knots)).abs().double()
    covariance = (1 + away) * torch.exp(-away)
    middle = torch.tensor([1.0, 23.0, 23.0, 1.0], dtype=torch.float64) / 48
    size = middle @ covariance[:4, :4] @ middle
    return torch.linalg.cholesky(covariance / size)


@register
@dataclass(frozen=True)
class Gust(Effect):
    """Ornstein-Uhlenbeck acceleration of standard deviation `sd_mps2` and `time_constant_s`, stationary; neutral at 0.

    Random: its deterministic response is zero; the noise model gains this force in both channels.

    Possible up to 0.6 m/s², the pull of unmodelled grades of 6 % (root mean square); a storm with a wind SD of 10 m/s
    causes 0.2 m/s² at 30 m/s. A time constant below 0.2 s is vibration, one above a minute is drift.

    Example:
        >>> import torch
        >>> from avtorch.gap import SimulatorInput, Gust, plant
        >>> time = torch.arange(2000, dtype=torch.float64) * 0.05
        >>> windy, drive = plant([Gust(sd_mps2=0.2)]), SimulatorInput(time, 0 * time, speed=torch.full_like(time, 20.0))
        >>> accel = windy.response(drive, generator=torch.Generator().manual_seed(0)).accel
        >>> windy.response(drive).accel.std().item(), round(accel.std().item(), 1)  # the mean response, and one drawn
        (0.0, 0.2)
    """

    sd_mps2: Number = 0.2
    time_constant_s: Number = 2.2

    name = "gust"
    place = "body"
    meaning = "wind and road push the car at random, for seconds"
    equation = "df = -f / tau dt + sd sqrt(2 / tau) dW"
    parameters = (
        Parameter("sd_mps2", "m/s²", 0.0, 0.1, 0.4, possible=(0.0, 0.6)),
        Parameter("time_constant_s", "s", None, 1.0, 5.0, possible=(0.2, 60.0)),
    )

    @classmethod
    def in_words(cls, values: Mapping[str, float]) -> str:
        return f"wind and road push the car at random by {values['sd_mps2']:.2g} m/s²"

    def advance(self, x: Tensor, row: EffectContext, state: Any) -> tuple[Tensor, Any]:
        if row.normal is None:
            return torch.zeros_like(x), None
        sd = tensor(self.sd_mps2)
        if state is None:
            force = sd * row.normal
        else:
            before, dt = state
            keep = torch.exp(-dt / tensor(self.time_constant_s))
            force = keep * before + sd * torch.sqrt(1 - keep.square()) * row.normal
        return force, (force, row.dt)

    def over(self, x: Tensor, row: EffectContext) -> Tensor:
        if row.normal is None:
            return torch.zeros_like(x)
        sd, dt = tensor(self.sd_mps2), row.dt.expand(row.time.shape)[..., :-1]
        keep = torch.exp(-dt / tensor(self.time_constant_s))
        first = sd[..., 0] * row.normal[..., 0] if sd.dim() else sd * row.normal[..., 0]
        later = scan(keep, sd * torch.sqrt(1 - keep.square()) * row.normal[..., 1:], first)
        return torch.cat([first.expand(later.shape[:-1])[..., None], later], -1)

    def noise(self, u: Tensor) -> NoiseChange:
        return NoiseChange(force_sd=tensor(self.sd_mps2), force_time=tensor(self.time_constant_s))
