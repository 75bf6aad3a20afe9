"""The parameters of the compiled plant, and the effects that own them.

A fit moves coordinates in which an effect vanishes at 0 and its response is nearly linear: a limit by its inverse, a
ratio by its logarithm, the period of a second pole by its square. Priors follow from the typical range that the
effect's own file states (`Parameter.low`, `Parameter.high`) by one rule, see `priors.SCALE_OF_RANGE`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from avtorch.arrays import FloatArray
from avtorch.gap.engine.priors import FAINT_OF_RANGE, SCALE_OF_RANGE
from avtorch.gap.simulator.effect import EFFECTS as TABLE
from avtorch.gap.simulator.effect import Effect
from avtorch.gap.simulator.parameter import Parameter

NAMES = (
    *("T_L", "K_L", "accel_delay", "speed_delay", "accel_filter", "speed_filter"),
    *("dead_time", "dead_band", "backlash", "hand_over", "drive_limit", "brake_limit"),
    *("log_brake_gain", "log_brake_lag", "square_period", "log_lag_ratio", "inverse_jerk", "log_fall"),
    *("lag_slope", "gain_slope", "gain_step", "gain_ramp", "shift_depth", "shift_duration", "shift_hysteresis"),
    *("ring_amplitude", "ring_quadrature", "ring_frequency", "ring_damping", "drag", "wind", "viscous"),
    *("resistance", "creep", "creep_fades"),
    *("sensor_lag", "sensor_bias", "sensor_scale", "speed_lag", "free_pole", "free_frequency"),
)
"""Of the value vector (parameter,), in its order."""
INDEX: dict[str, int] = {name: i for i, name in enumerate(NAMES)}
"""Places in the value vector; those of a user's own effects follow those of the table, see `adopt`."""

NEUTRAL: FloatArray = np.zeros(len(NAMES))
"""(parameter,): GLVD, and the values of what has no neutral one."""
for _name, _value in {
    "T_L": 0.3,
    "K_L": 1.0,
    "gain_ramp": -7.0,  # a millisecond
    "shift_duration": 0.35,
    "shift_hysteresis": 0.8,
    "ring_frequency": 2.0,
    "ring_damping": 0.08,
    "free_frequency": 1.8,
    "creep_fades": 3.0,
}.items():
    NEUTRAL[INDEX[_name]] = _value

FROM_THE_START = -1e18
"""Time [s] from which a parameter acts that acts all the time."""

Link = Literal["value", "inverse", "log", "square", "less one"]

_LINKS: Mapping[Link, tuple[Callable[[float], float], Callable[[float], float]]] = {
    "value": (lambda x: x, lambda z: z),
    "inverse": (lambda x: 1.0 / abs(x), lambda z: 1.0 / z if z > 1e-9 else math.inf),
    "log": (math.log, math.exp),
    "square": (lambda x: x * x, lambda z: math.sqrt(max(z, 0.0))),
    "less one": (lambda x: x - 1.0, lambda z: z + 1.0),
}


@dataclass(frozen=True)
class Coordinate:
    """One coordinate: `name` in the vector, `parameter` of the effect in the table, `link` from one to the other.

    `low`, `high`: limits of a fit. `mean` not None: a nuisance with a normal prior of that mean and `scale`; otherwise
    its size counts from `neutral` on, with a Student prior of that `scale` that vanishes below `faint`. `signed`:
    either sign is possible.
    """

    name: str
    parameter: str
    link: Link
    low: float
    high: float
    scale: float
    faint: float = 0.0
    mean: float | None = None
    sign: int = 1
    neutral: float = 0.0

    @property
    def signed(self) -> bool:
        return self.low < 0

    @property
    def step(self) -> float:
        """Of a finite difference: small against the prior, large against rounding."""
        return 0.025 * self.scale

    def value(self, z: float) -> float:
        """The effect's own parameter at coordinate `z`."""
        return self.sign * _LINKS[self.link][1](z)

    def coordinate(self, value: float) -> float:
        """The coordinate of an effect's own parameter."""
        if self.link == "inverse" and math.isinf(value):
            return 0.0
        return _LINKS[self.link][0](self.sign * value)


@dataclass(frozen=True)
class EngineEffect:
    """An effect as the search tries it: `coordinates`, the first of which has the size; `starts`, values of all.

    `onset`: "never" (it acts all the time), "may" set in during the drive, "must". `needs`: channels. `kind`: the class
    of a user's own effect, which the simulator runs; None: the compiled plant has it.
    """

    name: str
    coordinates: tuple[Coordinate, ...]
    starts: tuple[tuple[float, ...], ...]
    onset: Literal["never", "may", "must"] = "may"
    needs: frozenset[str] = field(default=frozenset())
    kind: type[Effect] | None = None

    def size(self, values: FloatArray, neutral: FloatArray) -> float:
        """How large it is at `values` (parameter,), in units of `faint`; infinite without a size."""
        sized = [c for c in self.coordinates if c.faint]
        if not sized:
            return math.inf
        return math.sqrt(sum(((values[INDEX[c.name]] - neutral[INDEX[c.name]]) / c.faint) ** 2 for c in sized))

    @property
    def base(self) -> str:
        """The name in the table, without what a variant adds."""
        return base_name(self.name)

    @property
    def one_sided(self) -> bool:
        """Whether it acts in one direction only, so that a fit cannot turn its sign."""
        return bool(self.coordinates) and not self.coordinates[0].signed


def base_name(effect: str) -> str:
    """The effect's name in the table: "second_order_actuator@late" is "second_order_actuator"."""
    return effect.split("@")[0]


def _from_range(
    name: str, of: Parameter, link: Link, low: float, high: float, sign: int = 1, neutral: float = 0.0
) -> Coordinate:
    """A coordinate whose prior follows from the typical range of its parameter."""
    to = _LINKS[link][0]
    away = sorted(abs(to(sign * x) - neutral) for x in (of.low, of.high))
    signed = link in ("log", "less one") or of.low < neutral < of.high
    size = SCALE_OF_RANGE * away[1], FAINT_OF_RANGE * (away[1] / 3 if signed else away[0])
    return Coordinate(name, of.name, link, low, high, *size, sign=sign, neutral=neutral)


def _sized(name: str, effect: str, parameter: str, link: Link, low: float, high: float, sign: int = 1) -> Coordinate:
    """The same of an effect of the table."""
    of = next(p for p in (*TABLE[effect].parameters, *TABLE[effect].derived) if p.name == parameter)
    return _from_range(name, of, link, low, high, sign)


def _nuisance(
    name: str, parameter: str, mean: float, sd: float, low: float, high: float, link: Link = "value"
) -> Coordinate:
    return Coordinate(name, parameter, link, low, high, sd, mean=mean)


def _lasting(name: str, effect: str, parameter: str) -> Coordinate:
    """The logarithm of a time, normal: its typical range holds four fifths; from a tenth of its end to hours."""
    of = next(p for p in TABLE[effect].parameters if p.name == parameter)
    low, high = math.log(of.low), math.log(of.high)
    mean, sd = 0.5 * (low + high), (high - low) / 2.56
    return Coordinate(name, parameter, "log", low - math.log(10), math.log(1e4), sd, mean=mean)


_SPEED, _ACCEL, _BOTH = frozenset({"speed"}), frozenset({"accel"}), frozenset({"accel", "speed"})


def _one(
    effect: str,
    parameter: str,
    limits: tuple[float, float],
    starts: tuple[float, ...],
    *,
    name: str = "",
    link: Link = "value",
    needs: frozenset[str] = frozenset(),
) -> EngineEffect:
    """An effect of one coordinate, which has the effect's name where no other is given."""
    coordinate = _sized(name or effect, effect, parameter, link, *limits)
    return EngineEffect(effect, (coordinate,), tuple((x,) for x in starts), "may", needs)


_SQUARE = Coordinate(
    "square_period", "inverse_frequency_s", "square", 0.0, 4.0, SCALE_OF_RANGE / 9, FAINT_OF_RANGE / 12**2
)
_SATURATION = (
    _sized("drive_limit", "saturation", "accel_max_mps2", "inverse", 0, 12),
    _sized("brake_limit", "saturation", "accel_min_mps2", "inverse", 0, 12, sign=-1),
)
_ASYMMETRY = (
    _sized("log_brake_gain", "brake_throttle_asymmetry", "brake_gain_ratio", "log", -2, 1.6),
    _sized("log_brake_lag", "brake_throttle_asymmetry", "brake_lag_ratio", "log", -1.5, 2.3),
)
_RATE_LIMIT = (
    _sized("inverse_jerk", "rate_limit", "jerk_max_mps3", "inverse", 0, 12),
    _nuisance("log_fall", "fall_ratio", 0.0, 0.7, -2.5, 2.5, "log"),
)
_GAIN_CHANGE = (
    _sized("gain_step", "gain_change", "gain_ratio", "less one", -0.9, 4),
    _lasting("gain_ramp", "gain_change", "ramp_s"),
)
_GEAR_SHIFT = (
    Coordinate("shift_depth", "depth", "value", 0, 1, 0.6 * 0.95, FAINT_OF_RANGE * 0.3),
    _nuisance("shift_duration", "duration_s", 0.35, 0.2, 0.06, 2.5),
)
_RING = (
    # a ring follows a step in its direction; the other sign would be one more lag
    Coordinate("ring_amplitude", "amplitude", "value", 0, 8, 0.3, FAINT_OF_RANGE * 0.5 / 3),
    _nuisance("ring_frequency", "frequency_hz", 2.5, 1.2, 0.8, 5.5),
    _nuisance("ring_damping", "mode_damping", 0.08, 0.05, 0.01, 0.2),  # more is no ring
)
_RING_STARTS = tuple((0.3, f, 0.08) for f in (1.0, 1.25, 1.6, 2.0, 2.5, 3.0, 3.6, 4.4))
_LINEAR = (
    _nuisance("free_pole", "", 0.0, 0.3, -3.0, 0.0),
    _nuisance("free_frequency", "", 1.8, 0.8, 0.6, 3.5),
)
_DRAG = (
    _sized("drag", "aerodynamic_drag", "drag_per_m", "value", 0, 0.05),
    _nuisance("wind", "wind_mps", 0.0, 3.0, -12.0, 12.0),
)
_CREEP = (
    _sized("creep", "low_speed_creep", "creep_mps2", "value", 0, 3),
    # an idling car rolls at 5 to 10 km/h
    _nuisance("creep_fades", "fades_at_mps", 2.5, 0.75, 0.5, 8.0),
)
_LATE_ACTUATOR = (_SQUARE, Coordinate("log_lag_ratio", "lag_ratio", "log", -2.5, 2.0, 0.7))

EFFECTS: dict[str, EngineEffect] = {
    e.name: e
    for e in (
        _one("dead_time", "delay_s", (0, 1.5), (0.06, 0.2, 0.4, 0.8)),
        _one("dead_band", "half_width_mps2", (0, 1.5), (0.05, 0.2, 0.5)),
        _one("backlash", "half_width_mps2", (0, 1.5), (0.05, 0.2, 0.5)),
        _one("hand_over", "pause_s", (0, 2), (0.1, 0.2, 0.4, 0.8, 1.2, 1.6)),
        EngineEffect("saturation", _SATURATION, ()),  # starts are quantiles of the command, see `search`
        EngineEffect("brake_throttle_asymmetry", _ASYMMETRY, ((-0.3, 0.0), (0.0, 0.6), (-0.3, 0.6), (0.3, 0.5))),
        EngineEffect("second_order_actuator", (_SQUARE,), ((0.01,), (0.04,), (0.1,), (0.7,)), "never"),
        EngineEffect("second_order_actuator@late", _LATE_ACTUATOR, ((0.02, -0.3), (0.1, -1.0), (0.7, 0.0)), "must"),
        EngineEffect("rate_limit", _RATE_LIMIT, ((0.4, 0.0), (1.0, 0.0), (2.5, 0.0))),
        _one("speed_dependent_lag", "lag_slope", (-2.5, 2.5), (0.3, -0.3, -0.8, 0.8), name="lag_slope", needs=_SPEED),
        _one("speed_dependent_gain", "gain_slope", (-2, 2), (0.2, -0.2), name="gain_slope", needs=_SPEED),
        EngineEffect("gain_change", _GAIN_CHANGE, ((0.2, 0.0),), "must"),
        EngineEffect("gear_shift", _GEAR_SHIFT, ((0.6, 0.35), (0.9, 0.7)), "may", _SPEED),
        EngineEffect("driveline_oscillation", _RING, _RING_STARTS, "may", _BOTH),
        EngineEffect("~linear", _LINEAR, ((-0.2, 1.0), (-0.2, 1.8), (-0.8, 1.8), (-0.2, 2.8)), "never"),
        EngineEffect("command_hold", (), ((),), "never"),
        EngineEffect("aerodynamic_drag", _DRAG, ((4e-4, 0.0), (4e-4, 5.0)), "may", _SPEED),
        _one("viscous_drag", "drag_per_s", (0, 2), (0.012,), name="viscous", needs=_SPEED),
        _one("constant_resistance", "resistance_mps2", (0, 4), (0.1,), name="resistance"),
        EngineEffect("low_speed_creep", _CREEP, ((0.3, 3.0), (0.3, 2.0)), "may", _SPEED),
        _one("sensor_lag", "lag_s", (0, 6), (0.1, 0.3), needs=_ACCEL),
        _one("sensor_bias", "bias_mps2", (-4, 4), (0.1,), needs=_ACCEL),
        _one("sensor_scale", "scale", (-0.7, 1.5), (0.1,), link="less one", needs=_BOTH),
        _one("speed_lag", "lag_s", (0, 6), (0.2, 0.5), needs=_BOTH),
    )
}
"""The effects that the search tries, in the chain's order; what chance decides (gust, road, outliers) is not a plant's.

`"~linear"` is the car's own unnamed linear dynamics, a mode without resonance."""

COORDINATES: dict[str, Coordinate] = {c.name: c for e in EFFECTS.values() for c in e.coordinates}
"""Coordinates of effects by their names."""


def neutral_values() -> FloatArray:
    """A new value vector (parameter,) at which the plant is GLVD."""
    out = np.zeros(len(INDEX))
    out[: len(NEUTRAL)] = NEUTRAL
    for c in COORDINATES.values():
        if INDEX[c.name] >= len(NEUTRAL):
            out[INDEX[c.name]] = c.neutral
    return out


def adopt(kind: type[Effect]) -> EngineEffect:
    """A user's own effect as the search tries it: a coordinate for each parameter, priors by the same rules."""
    known = EFFECTS.get(kind.name)
    if known is not None and (known.kind is kind or (known.kind is None and TABLE.get(kind.name) is kind)):
        return known
    coordinates = tuple(_own(kind, p) for p in kind.parameters)
    for c in coordinates:
        INDEX.setdefault(c.name, len(INDEX))
        COORDINATES[c.name] = c
    typical = [c.coordinate(float(p.typical())) for c, p in zip(coordinates, kind.parameters, strict=False)]
    starts = [tuple(typical)]
    if coordinates and coordinates[0].signed:
        starts.append((-typical[0], *typical[1:]))
    if coordinates:  # a bound that is never reached has no slope: from either end of its range, too
        ends = next((p.low, p.high) for p in kind.parameters if p.name == coordinates[0].parameter)
        starts += [(coordinates[0].coordinate(x), *typical[1:]) for x in ends]
    needs = _SPEED if kind.needs_speed else frozenset[str]()
    if kind.place == "sensor":
        needs = _BOTH
    EFFECTS[kind.name] = EngineEffect(kind.name, coordinates, tuple(starts), "never", needs, kind)
    return EFFECTS[kind.name]


def _own(kind: type[Effect], p: Parameter) -> Coordinate:
    name, (low, high) = f"{kind.name}.{p.name}", p.physical
    if p.neutral is None:
        mean = float(p.typical())
        return Coordinate(name, p.name, "value", low, high, (p.high - p.low) / 2.56, mean=mean, neutral=mean)
    if math.isinf(p.neutral):
        most = 1 / max(min(abs(low), abs(high)), 1e-9)
        return _from_range(name, p, "inverse", 0, most, 1 if p.neutral > 0 else -1)
    if p.constraint == "positive" and p.neutral == 1:
        return _from_range(name, p, "log", math.log(low), math.log(high))
    return _from_range(name, p, "value", min(low, p.neutral), max(high, p.neutral), neutral=p.neutral)
