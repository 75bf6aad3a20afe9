"""Effects within the actuator: its gain, its lag, its order."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
import torch
from numba import njit
from torch import Tensor

from avtorch.arrays import FloatArray, IntArray
from avtorch.errors import InputError
from avtorch.gap.simulator.effect import Domain, Effect, EffectContext, Parameter, register
from avtorch.vehicle.arguments import Number, tensor

_NO_OVERSHOOT = 0.8
"""Damping from which a step overshoots by less than 2 %."""


@register
@dataclass(frozen=True)
class SecondOrderActuator(Effect):
    """`a'' / omega² + 2 zeta a' / omega + a = K u` in place of the one pole.

    Fitted as `tau² a'' + T_L a' + a = K u` with `tau = inverse_frequency_s`: neutral at 0, where it is exactly GLVD,
    and `T_L` keeps its meaning, the slope of the phase. The answer reports `natural_frequency_radps = 1 / tau` and
    `damping_ratio = T_L / (2 tau)`. With `damping_ratio` given, `plant` sets `T_L` to `2 zeta tau`; from then on `T_L`
    determines the damping, and the effect in the plant has no `damping_ratio` of its own. With an onset during a drive,
    `T_L` is the lag before it and `lag_ratio` times `T_L` the lag after it.

    Possible are 0.5 to 60 rad/s, periods of 12 s to 0.1 s, with damping ratios of 0.03 to 5.

    Example:
        >>> import torch
        >>> from avtorch.gap import SimulatorInput, SecondOrderActuator, plant
        >>> time = torch.arange(400, dtype=torch.float64) * 0.01
        >>> car = plant([SecondOrderActuator(inverse_frequency_s=0.2, damping_ratio=0.3)])
        >>> round(car.response(SimulatorInput(time, (time >= 0.5).double())).accel.max().item(), 2)  # it overshoots
        1.37
    """

    inverse_frequency_s: Number = 1 / 6
    damping_ratio: Number | None = None
    lag_ratio: Number = 1.0

    name = "second_order_actuator"
    place = "actuator"
    order = 1
    meaning = "the actuator has inertia and may overshoot"
    equation = "a'' = omega² (K u - a) - 2 zeta omega a'"
    parameters = (
        Parameter("inverse_frequency_s", "s", 0.0, 1 / 12, 1 / 3, reported=False),
        Parameter("lag_ratio", "-", 1.0, 0.65, 1 / 0.65, reported=False, of_onset=True),
    )
    derived = (
        Parameter("natural_frequency_radps", "rad/s", None, 3.0, 12.0, possible=(0.5, 60.0)),
        Parameter("damping_ratio", "-", None, 0.2, 0.9, possible=(0.03, 5.0)),
    )
    settings = (Domain("natural_frequency_radps", 1e-3, 1e5, "rad/s"), Domain("damping_ratio", 1e-3, 1e3))

    @classmethod
    def in_words(cls, values: Mapping[str, float]) -> str:
        ends = "overshoots" if values["damping_ratio"] < _NO_OVERSHOOT else "has inertia"
        return f"the actuator {ends} with a natural frequency of {values['natural_frequency_radps']:.2g} rad/s"

    def apply(self, x: Tensor, row: EffectContext) -> tuple[float, Tensor]:
        return 1.0, tensor(self.lag_ratio)  # the second derivative is integrated in the actuator, see `actuator.py`

    def actuator_parameters(self) -> Mapping[str, Tensor]:
        return {"tau": tensor(self.inverse_frequency_s)}

    def report(self, T_L: Tensor) -> dict[str, Tensor]:
        tau = tensor(self.inverse_frequency_s)
        return {"natural_frequency_radps": 1 / tau, "damping_ratio": T_L * tensor(self.lag_ratio) / (2 * tau)}

    @classmethod
    def of(cls, values: Mapping[str, Any]) -> Self:
        """The effect from `natural_frequency_radps` and `damping_ratio` (without it the plant keeps its `T_L`)."""
        given = dict(values)
        if "natural_frequency_radps" in given:
            frequency = given.pop("natural_frequency_radps")
            if not bool(torch.all(tensor(frequency) > 0)):
                raise InputError(f"natural_frequency_radps: found {frequency!r}, needs > 0 rad/s")
            given["inverse_frequency_s"] = 1 / frequency
        return super().of(given)

    def lag_apart(self) -> tuple[Self, Tensor | None]:
        if self.damping_ratio is None:
            return self, None
        lag = 2 * tensor(self.damping_ratio) * tensor(self.inverse_frequency_s)
        return replace(self, damping_ratio=None), lag


_ALIKE_LIMITS = 0.1
"""Of the logarithms of both limits: what is not worth a word."""


@register
@dataclass(frozen=True)
class RateLimit(Effect):
    """`da/dt` of the actuator at most `jerk_max_mps3`, where it falls `fall_ratio` times that; neutral at infinity.

    Behind a second-order actuator the set-point `K u` is slewed instead, with the same limits.

    Possible are 0.1 m/s³ (ten seconds to a gentle acceleration) to 50 m/s³ (an emergency brake).

    Example:
        >>> import torch
        >>> from avtorch.gap import SimulatorInput, RateLimit, plant
        >>> time = torch.arange(200, dtype=torch.float64) * 0.02
        >>> step = SimulatorInput(time, 2 * (time >= 0.5).double())
        >>> accel = plant([RateLimit(jerk_max_mps3=1.4)]).response(step).accel
        >>> round((accel.diff() / 0.02).max().item(), 2)  # m/s³
        1.4
    """

    jerk_max_mps3: Number = 1.4
    fall_ratio: Number = 1.0

    name = "rate_limit"
    place = "actuator"
    order = 2
    meaning = "the actuator's jerk is bounded"
    equation = "da/dt = (K u - a) / T_L from -fall_ratio jerk_max to jerk_max"
    parameters = (
        Parameter("jerk_max_mps3", "m/s³", float("inf"), 0.5, 4.0, possible=(0.1, 50.0)),
        Parameter("fall_ratio", "-", None, 0.4, 2.5, possible=(0.05, 20.0)),
    )

    @classmethod
    def in_words(cls, values: Mapping[str, float]) -> str:
        rise, fall = values["jerk_max_mps3"], values["jerk_max_mps3"] * values.get("fall_ratio", 1.0)
        if abs(math.log(fall / rise)) < _ALIKE_LIMITS:
            return f"the acceleration changes by at most {rise:.2g} m/s³"
        return f"the acceleration rises by at most {rise:.2g} m/s³ and falls by at most {fall:.2g} m/s³"

    def apply(self, x: Tensor, row: EffectContext) -> tuple[float, float]:
        return 1.0, 1.0  # the limit is applied in the actuator, see `actuator.py`

    def actuator_parameters(self) -> Mapping[str, Tensor]:
        return {"jerk": tensor(self.jerk_max_mps3), "fall": tensor(self.fall_ratio)}


_ALIKE_RATIOS = 0.05
"""Difference of a ratio from 1 that is not worth a word."""


@register
@dataclass(frozen=True)
class BrakeThrottleAsymmetry(Effect):
    """Gain and lag times `brake_gain_ratio`, `brake_lag_ratio` where the command is negative; neutral at 1, 1.

    Possible are ratios up to five either way for the gain and ten for the lag, as between air brakes and a motor.

    Example:
        >>> import torch
        >>> from avtorch.gap import BrakeThrottleAsymmetry, SimulatorInput, plant
        >>> time = torch.arange(500, dtype=torch.float64) * 0.02
        >>> command = torch.stack([torch.ones(500), -torch.ones(500)]).double()
        >>> car = plant([BrakeThrottleAsymmetry(brake_gain_ratio=0.7)])
        >>> [round(a, 1) for a in car.response(SimulatorInput(time, command)).accel[:, -1].tolist()]
        [1.0, -0.7]
    """

    brake_gain_ratio: Number = 0.7
    brake_lag_ratio: Number = 2.0

    name = "brake_throttle_asymmetry"
    place = "actuator"
    meaning = "gain and lag differ between braking and driving"
    equation = "K_L, T_L times ratios where u < 0"
    parameters = (
        Parameter("brake_gain_ratio", "-", 1.0, 0.5, 0.9, possible=(0.2, 5.0)),
        Parameter("brake_lag_ratio", "-", 1.0, 1.3, 3.0, possible=(0.1, 10.0)),
    )

    @classmethod
    def in_words(cls, values: Mapping[str, float]) -> str:
        gain, lag = values["brake_gain_ratio"], values["brake_lag_ratio"]
        told = []
        if abs(gain - 1) >= _ALIKE_RATIOS:
            told.append("weaker" if gain < 1 else "stronger")
        if abs(lag - 1) >= _ALIKE_RATIOS or not told:
            told.append("quicker" if lag < 1 else "slower")
        return f"the brake is {' and '.join(told)} than the throttle"

    def apply(self, x: Tensor, row: EffectContext) -> tuple[Tensor, Tensor]:
        braking = x < 0
        return (
            torch.where(braking, tensor(self.brake_gain_ratio), 1.0),
            torch.where(braking, tensor(self.brake_lag_ratio), 1.0),
        )


class _SlopeOverSpeed(Effect):
    """A factor that is 1 at `pivot` [-] times `mean_speed` [m/s], which is taken from a drive."""

    mean_speed: Number
    pivot: Number

    place = "actuator"
    needs_speed = True
    settings = (Domain("mean_speed", 0.1, 150.0, "m/s"),)

    def _factor(self, slope: Number, row: EffectContext, least: float) -> Tensor:
        """At least `least`, outside a drive's range of speeds."""
        away = row.speed / (tensor(self.mean_speed) * tensor(self.pivot)) - 1
        return (1 + tensor(slope) * away).clamp_min(least)

    def prepared(self, time: Tensor, speed: Tensor | None, position: Tensor | None) -> Self:
        if speed is None:
            return self
        moving = speed[speed > 0.3]
        return replace(self, mean_speed=float(moving.mean())) if len(moving) else self


@register
@dataclass(frozen=True)
class SpeedDependentLag(_SlopeOverSpeed):
    """`T_L (1 + lag_slope (v - v_mean) / v_mean)`; neutral at 0. `mean_speed` [m/s] is taken from a drive.

    `pivot` [-]: the speed, relative to the mean one, at which the lag is unchanged. It only rescales T_L if the effect
    has no onset, and is then 1.

    Possible up to 2 either way, where the lag vanishes at half or at one and a half times the mean speed.

    Example:
        >>> import torch
        >>> from avtorch.gap import SimulatorInput, SpeedDependentLag, plant
        >>> time = torch.arange(60, dtype=torch.float64) * 0.05
        >>> speed = torch.tensor([[5.0], [25.0]], dtype=torch.float64).expand(2, 60)
        >>> car, step = plant([SpeedDependentLag(0.5)]), (time >= 0.5).double().expand(2, 60)
        >>> slow, quick = car.response(SimulatorInput(time, step, speed=speed)).accel[:, 20].tolist()
        >>> slow > quick  # 0.5 s after the step: the lag grows with the speed
        True
    """

    lag_slope: Number = 0.5
    mean_speed: Number = 15.0
    pivot: Number = 1.0

    name = "speed_dependent_lag"
    meaning = "the actuator is slower at some speeds"
    equation = "T_L (1 + slope (v - v_mean) / v_mean)"
    parameters = (
        Parameter("lag_slope", "-", 0.0, -0.7, 0.7, "real", possible=(-2.0, 2.0)),
        Parameter("pivot", "-", None, 0.6, 1 / 0.6, reported=False, of_onset=True),
    )

    @classmethod
    def in_words(cls, values: Mapping[str, float]) -> str:
        return f"the actuator is slower the {'faster' if values['lag_slope'] > 0 else 'slower'} the car is"

    def apply(self, x: Tensor, row: EffectContext) -> tuple[float, Tensor]:
        return 1.0, self._factor(self.lag_slope, row, 0.05)


@register
@dataclass(frozen=True)
class SpeedDependentGain(_SlopeOverSpeed):
    """`K_L (1 + gain_slope (v - v_mean) / v_mean)`; neutral at 0. `mean_speed` [m/s] is taken from a drive.

    `pivot` [-]: the speed, relative to the mean one, at which the gain is unchanged. It only rescales K_L if the effect
    has no onset, and is then 1.

    Possible up to 2 either way, where the gain vanishes at half or at one and a half times the mean speed.

    Example:
        >>> import torch
        >>> from avtorch.gap import SimulatorInput, SpeedDependentGain, plant
        >>> time = torch.arange(200, dtype=torch.float64) * 0.05
        >>> speed = torch.tensor([[5.0], [25.0]], dtype=torch.float64).expand(2, 200)
        >>> car = plant([SpeedDependentGain(0.3, mean_speed=15.0)])
        >>> pulling = SimulatorInput(time, torch.ones_like(speed), speed=speed)
        >>> car.response(pulling).accel[:, -1].round(decimals=2).tolist()
        [0.8, 1.2]
    """

    gain_slope: Number = 0.3
    mean_speed: Number = 15.0
    pivot: Number = 1.0

    name = "speed_dependent_gain"
    meaning = "the realised share of the command depends on speed"
    equation = "K_L (1 + slope (v - v_mean) / v_mean)"
    parameters = (
        Parameter("gain_slope", "-", 0.0, -0.4, 0.4, "real", possible=(-2.0, 2.0)),
        Parameter("pivot", "-", None, 0.6, 1 / 0.6, reported=False, of_onset=True),
    )

    @classmethod
    def in_words(cls, values: Mapping[str, float]) -> str:
        return f"commands do {'more' if values['gain_slope'] > 0 else 'less'} the faster the car is"

    def apply(self, x: Tensor, row: EffectContext) -> tuple[Tensor, float]:
        return self._factor(self.gain_slope, row, 0.0), 1.0


@register
@dataclass(frozen=True)
class GainChange(Effect):
    """`K_L` times `gain_ratio` from `change_s` on, reached over `ramp_s` (near 0: a step); neutral at ratio 1.

    A row takes the mean over its step, so the response is differentiable in the change time. The prior of that time is
    uniform over the drive, `earliest_s … latest_s`; raises `InputError` unless the former is less.

    Possible are ratios up to five either way: the payload of a truck, brake fade. The change time is unrestricted.

    Example:
        >>> import torch
        >>> from avtorch.gap import SimulatorInput, GainChange, plant
        >>> time = torch.arange(800, dtype=torch.float64) * 0.05
        >>> heavier = plant([GainChange(gain_ratio=0.75, change_s=20.0)])
        >>> accel = heavier.response(SimulatorInput(time, torch.ones_like(time))).accel
        >>> accel[[399, 799]].round(decimals=2).tolist()
        [1.0, 0.75]
    """

    gain_ratio: Number = 0.75
    change_s: Number = 30.0
    ramp_s: Number = 0.0
    earliest_s: float = 0.0
    latest_s: float = 60.0

    name = "gain_change"
    place = "actuator"
    meaning = "the gain changes at some time during the drive"
    equation = "K_L (1 + (ratio - 1) clip((t - t_change) / ramp, 0, 1))"
    own_onset = "change_s"
    of_the_drive = True
    parameters = (
        Parameter("gain_ratio", "-", 1.0, 0.65, 1.4, possible=(0.2, 5.0)),
        Parameter("change_s", "s", None, 0.0, 60.0, "interval", possible=(-math.inf, math.inf)),
        Parameter("ramp_s", "s", None, 0.5, 60.0, reported=False),
    )
    settings = (
        Domain("ramp_s", 0.0, 1e6, "s"),
        Domain("earliest_s", -1e12, 1e12, "s"),
        Domain("latest_s", -1e12, 1e12, "s"),
    )

    @classmethod
    def in_words(cls, values: Mapping[str, float]) -> str:
        ratio = values["gain_ratio"]
        return f"the gain {'falls' if ratio < 1 else 'rises'} to {100 * ratio:.0f} % during the drive"

    def __post_init__(self) -> None:
        if not self.earliest_s < self.latest_s:
            raise InputError(
                f"gain_change: found earliest_s {self.earliest_s:g} and latest_s {self.latest_s:g}, needs the earliest "
                "before the latest"
            )

    def apply(self, x: Tensor, row: EffectContext) -> tuple[Tensor, float]:
        ramp = tensor(self.ramp_s).clamp_min(1e-6)
        since = row.time - tensor(self.change_s)
        share = (_area(since + row.dt, ramp) - _area(since, ramp)) / row.dt
        return 1 + (tensor(self.gain_ratio) - 1) * share, 1.0

    def coordinates(self) -> tuple[Parameter, ...]:
        ratio, change, ramp = self.parameters
        return ratio, replace(change, low=self.earliest_s, high=self.latest_s), ramp

    def prepared(self, time: Tensor, speed: Tensor | None, position: Tensor | None) -> Self:
        first, last = float(time[0]), float(time[-1])
        return replace(self, earliest_s=first, latest_s=max(last, math.nextafter(first, math.inf)))


def _area(since: Tensor, ramp: Tensor) -> Tensor:
    """Integral of the ramp up to `since` [s]."""
    within = torch.minimum(since.clamp_min(0.0), ramp)
    return within.square() / (2 * ramp) + (since - ramp).clamp_min(0.0)


_NEVER = -1e9
_SHIFTS = 6


@register
@dataclass(frozen=True)
class GearShift(Effect):
    """Where the speed rises through one of `speeds` [m/s], a positive command loses the share `depth` for `duration_s`.

    Neutral at depth 0. Without `speeds`, they are those of a gearbox with constant ratio: `first_mps`, each next one
    `gear_ratio` times the previous. Once the speed has fallen `rearm_mps` below a shift speed, the gear has changed
    back, without an interruption. The crossing is interpolated between rows, and a row loses drive for the part of
    its step that lies in the interruption, so the response is differentiable in duration and speeds.

    Possible are interruptions of 0.02 s (dual clutch) to 2.5 s (automated gearbox of a truck).

    Example:
        >>> import torch
        >>> from avtorch.gap import SimulatorInput, GearShift, plant
        >>> time = torch.arange(200, dtype=torch.float64) * 0.05
        >>> pulling = SimulatorInput(time, torch.ones_like(time), speed=4.0 + time)  # shifts at 4.5, 6.75, 10.1 m/s
        >>> accel = plant([GearShift(depth=0.7)], T_L=0.1).response(pulling).accel
        >>> accel.max().item() - accel.min().item() > 0.5
        True
    """

    depth: Number = 0.7
    duration_s: Number = 0.25
    first_mps: Number = 4.5
    gear_ratio: Number = 1.5
    speeds: tuple[float, ...] | None = None
    rearm_mps: float = 1.5

    name = "gear_shift"
    place = "actuator"
    needs_speed = True
    meaning = "upshifts at certain speeds interrupt the drive torque"
    equation = "K_L (1 - depth) for duration after each upshift, where u > 0"
    of_the_drive = True
    parameters = (
        Parameter("depth", "-", 0.0, 0.3, 0.95, "unit"),
        Parameter("duration_s", "s", None, 0.1, 0.6, possible=(0.02, 2.5)),
        Parameter("first_mps", "m/s", None, 3.0, 7.0, reported=False),
        Parameter("gear_ratio", "-", None, 1.3, 1.8, reported=False),
    )
    settings = (
        Domain("speeds", 0.1, 150.0, "m/s", most=16, rising=True),
        Domain("rearm_mps", 0.0, 20.0, "m/s"),
    )

    @classmethod
    def in_words(cls, values: Mapping[str, float]) -> str:
        return f"upshifts interrupt the drive torque for {values['duration_s']:.2g} s"

    def start(self, x: Tensor, row: EffectContext) -> list[tuple[Tensor, Tensor, Tensor]]:
        """State of each shift: speed one row ago, whether above, start of the last interruption."""
        v = row.speed
        return [(v, v > s, torch.full_like(v, _NEVER)) for s in self._thresholds()]

    def advance(
        self, x: Tensor, row: EffectContext, state: list[tuple[Tensor, Tensor, Tensor]]
    ) -> tuple[tuple[Tensor, float], list[tuple[Tensor, Tensor, Tensor]]]:
        v, lost, after = row.speed, torch.zeros(()), []
        for s, (v_before, above, since) in zip(self._thresholds(), state, strict=True):
            up = ~above & (v > s)
            since = torch.where(up, self._crossing(v_before, v, s, row.time, row.dt), since)
            above = (above | up) & (v > s - self.rearm_mps)
            lost = torch.maximum(lost, _covered(since, tensor(self.duration_s), row.time, row.dt))
            after.append((v, above, since))
        return (self._factor(lost, x), 1.0), after

    def over(self, x: Tensor, row: EffectContext) -> tuple[Tensor, float]:
        v, lost = row.speed, torch.zeros(())
        for s in self._thresholds():
            shape = np.broadcast_shapes(v.shape, s.shape)
            columns = v.expand(shape).reshape(-1, shape[-1]).contiguous().numpy()
            levels = s.detach().expand(*shape[:-1], 1).reshape(-1).contiguous().numpy()
            last = torch.from_numpy(_last_upshift(columns, levels, self.rearm_mps)).reshape(shape)
            up = last.clamp_min(1)
            before, after, time, dt = (
                y.expand(shape).gather(-1, at) for y, at in ((v, up - 1), (v, up), (row.time, up), (row.dt, up))
            )
            since = torch.where(last > 0, self._crossing(before, after, s, time, dt), _NEVER)
            lost = torch.maximum(lost, _covered(since, tensor(self.duration_s), row.time, row.dt))
        return self._factor(lost, x), 1.0

    def _thresholds(self) -> list[Tensor]:
        if self.speeds is not None:
            return [tensor(s) for s in self.speeds]
        return [tensor(self.first_mps) * tensor(self.gear_ratio) ** i for i in range(_SHIFTS)]

    @staticmethod
    def _crossing(before: Tensor, v: Tensor, s: Tensor, time: Tensor, dt: Tensor) -> Tensor:
        """Start of the interruption: one row after the crossing, so that it is known when a step begins."""
        gained = v - before
        share = ((v - s) / torch.where(gained > 0, gained, 1.0)).clamp(0.0, 1.0)
        return time + (1 - share) * dt

    def _factor(self, lost: Tensor, x: Tensor) -> Tensor:
        return 1 - tensor(self.depth) * lost * (x > 0)


def _covered(since: Tensor, duration: Tensor, time: Tensor, dt: Tensor) -> Tensor:
    """Share of a step that lies in an interruption."""
    return ((torch.minimum(time + dt, since + duration) - torch.maximum(time, since)) / dt).clamp_min(0.0)


@njit(cache=True)
def _last_upshift(v: FloatArray, s: FloatArray, rearm: float) -> IntArray:  # pragma: no cover - compiled
    """Row (column, time) of the latest rise of `v` (column, time) through `s` (column,); -1 before the first."""
    out = np.empty(v.shape, np.int64)
    for c in range(len(v)):
        above, last = v[c, 0] > s[c], -1
        for k in range(v.shape[1]):
            if v[c, k] > s[c] and not above:
                above, last = True, k
            above = above and v[c, k] > s[c] - rearm
            out[c, k] = last
    return out
