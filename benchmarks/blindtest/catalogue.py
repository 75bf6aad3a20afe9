"""The causes that a case may contain: the effects of the table, and families outside the table.

A cause is drawn for a car and a drive, all but its strength, which scales it: 1 is the middle of what cars have, 0 no
effect, `strongest` the upper limit. Families outside the table are split permanently: those in `CALIBRATION` may serve
to calibrate `unknown`, those in `SEALED` never do.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from avtorch.errors import InputError
from benchmarks.blindtest.car import Car
from benchmarks.blindtest.drives import TYPICAL_SPEED_MPS, DrivePlan, Manoeuvre

Place = Literal["command", "actuator", "body", "sensor"]
AtStrength = Callable[[float], dict[str, float]]
Draw = Callable[[np.random.Generator, Car, DrivePlan], AtStrength]


@dataclass(frozen=True)
class Family:
    """A cause: its `name`, its `place` in the chain, how it is drawn, its `strongest`.

    `by_chance`: its effect on single rows is random, so no rollout predicts it, only the predictive density shows it.
    `suits`: the manoeuvres in which it can be visible (empty: all of them).

    Example:
        >>> from benchmarks.blindtest import Family, family
        >>> dead_time: Family = family("dead_time")
        >>> dead_time.place, dead_time.by_chance
        ('command', False)
    """

    name: str
    place: Place
    draw: Draw = field(repr=False)
    strongest: float
    by_chance: bool = False
    suits: tuple[Manoeuvre, ...] = ()


_ROUGH: tuple[Manoeuvre, ...] = ("following", "stop_and_go", "steps")


def _sign(rng: np.random.Generator) -> float:
    return 1.0 if rng.random() < 0.5 else -1.0


def _fixed(**keys: float) -> Draw:
    """Parameters that all scale with the strength."""
    return lambda rng, car, drive: lambda s: {key: value * s for key, value in keys.items()}


def _saturation(rng: np.random.Generator, car: Car, drive: DrivePlan) -> AtStrength:
    high, low = rng.uniform(1.0, 1.8), -rng.uniform(1.5, 3.0)
    return lambda s: {"accel_max_mps2": high / s, "accel_min_mps2": low / s}


def _asymmetry(rng: np.random.Generator, car: Car, drive: DrivePlan) -> AtStrength:
    gain, lag = rng.uniform(0.6, 0.85), rng.uniform(0.4, 1.3)
    return lambda s: {"brake_gain_ratio": gain**s, "brake_lag_ratio": 1 + lag * s}


def _second_order(rng: np.random.Generator, car: Car, drive: DrivePlan) -> AtStrength:
    # the sum of both lags stays at T_L, so that strength 0 is the unchanged car
    zeta = rng.uniform(0.35, 0.75)
    omega = 2 * zeta / car.T_L
    return lambda s: {"natural_frequency_radps": omega / s, "damping_ratio": zeta / s}


def _rate_limit(rng: np.random.Generator, car: Car, drive: DrivePlan) -> AtStrength:
    fall = 1.0 if rng.random() < 0.5 else float(np.exp(rng.normal(0.0, 0.5)))
    return lambda s: {"jerk_max_mps3": 1.5 / s, "fall_ratio": fall}


def _speed_lag(rng: np.random.Generator, car: Car, drive: DrivePlan) -> AtStrength:
    slope = 0.5 * _sign(rng)
    middle = TYPICAL_SPEED_MPS[drive.manoeuvre]
    return lambda s: {"lag_slope": slope * s, "reference_speed_mps": middle}


def _speed_gain(rng: np.random.Generator, car: Car, drive: DrivePlan) -> AtStrength:
    slope = 0.28 * _sign(rng)
    middle = TYPICAL_SPEED_MPS[drive.manoeuvre]
    return lambda s: {"gain_slope": slope * s, "reference_speed_mps": middle}


def _gain_change(rng: np.random.Generator, car: Car, drive: DrivePlan) -> AtStrength:
    ratio = float(rng.choice([0.72, 1.3]))
    when = drive.seconds * rng.uniform(0.25, 0.75)
    takes = 0.2 if rng.random() < 0.5 else float(rng.uniform(0.05, 0.2)) * drive.seconds
    return lambda s: {"gain_ratio": ratio**s, "change_s": when, "takes_s": takes}


def _gear_shift(rng: np.random.Generator, car: Car, drive: DrivePlan) -> AtStrength:
    lasts, first, ratio = rng.uniform(0.2, 0.5), rng.uniform(3.5, 6.0), rng.uniform(1.4, 1.7)
    return lambda s: {
        "depth": min(1.0, 0.7 * s),
        "duration_s": lasts * max(1.0, 0.7 * s),
        "first_shift_mps": first,
        "shift_ratio": ratio,
    }


def _driveline(rng: np.random.Generator, car: Car, drive: DrivePlan) -> AtStrength:
    hertz, zeta = rng.uniform(1.2, 4.5), rng.uniform(0.03, 0.1)
    return lambda s: {"frequency_hz": hertz, "amplitude": 1.0 * s, "damping_ratio": zeta}


def _drag(rng: np.random.Generator, car: Car, drive: DrivePlan) -> AtStrength:
    wind, swing, period = rng.uniform(-4, 4), rng.uniform(0, 1), rng.uniform(40, 120)
    return lambda s: {"drag_per_m": 4e-4 * s, "wind_mps": wind, "wind_swing_mps": swing, "wind_period_s": period}


def _grade(rng: np.random.Generator, car: Car, drive: DrivePlan) -> AtStrength:
    length = rng.uniform(80, 250)
    return lambda s: {"grade_rms": 0.03 * s, "length_m": length}


def _creep(rng: np.random.Generator, car: Car, drive: DrivePlan) -> AtStrength:
    ends = rng.uniform(2.8, 3.6)
    return lambda s: {"creep_mps2": 0.3 * s, "ends_mps": ends}


def _gust(rng: np.random.Generator, car: Car, drive: DrivePlan) -> AtStrength:
    memory = rng.uniform(1, 5)
    return lambda s: {"sd_mps2": 0.2 * s, "time_constant_s": memory}


def _bias(rng: np.random.Generator, car: Car, drive: DrivePlan) -> AtStrength:
    sign = _sign(rng)
    return lambda s: {"bias_mps2": 0.15 * sign * s}


def _scale(rng: np.random.Generator, car: Car, drive: DrivePlan) -> AtStrength:
    sign = _sign(rng)
    return lambda s: {"scale": 1 + 0.12 * sign * s}


def _outliers(rng: np.random.Generator, car: Car, drive: DrivePlan) -> AtStrength:
    scale = rng.uniform(6, 11)
    return lambda s: {"fraction": 0.02 * s, "scale": scale}


def _vibration(rng: np.random.Generator, car: Car, drive: DrivePlan) -> AtStrength:
    turns, idle = rng.uniform(1.5, 3.0), rng.uniform(10, 14) + 0.5 * drive.rate_hz
    return lambda s: {"amplitude_mps2": 0.1 * s, "turns_per_m": turns, "idle_hz": idle}


def _blending(rng: np.random.Generator, car: Car, drive: DrivePlan) -> AtStrength:
    regen, weaker = rng.uniform(0.2, 0.6), rng.uniform(0.15, 0.35)
    return lambda s: {"regen_mps2": regen, "hysteresis_mps2": 0.1 * s, "friction_gain": max(0.2, 1 - weaker * s)}


def _clock(rng: np.random.Generator, car: Car, drive: DrivePlan) -> AtStrength:
    reset = rng.uniform(8, 40)
    return lambda s: {"drift_s": 0.2 * s, "reset_s": reset}


def _heat(rng: np.random.Generator, car: Car, drive: DrivePlan) -> AtStrength:
    cool = rng.uniform(20, 60)
    return lambda s: {"loss_when_hot": 0.5 * s, "cooling_s": cool}


def _curves(rng: np.random.Generator, car: Car, drive: DrivePlan) -> AtStrength:
    quick = TYPICAL_SPEED_MPS[drive.manoeuvre]
    return lambda s: {"drag_at_3mps2": 0.3 * s, "reference_speed_mps": quick}


def _abs(rng: np.random.Generator, car: Car, drive: DrivePlan) -> AtStrength:
    above, hertz = rng.uniform(0.3, 1.0), rng.uniform(1.5, 5)
    return lambda s: {"depth": min(1.0, 0.4 * s), "threshold_mps2": above, "frequency_hz": hertz}


def _jitter(rng: np.random.Generator, car: Car, drive: DrivePlan) -> AtStrength:
    period = rng.uniform(8, 30)
    return lambda s: {"swing_s": 0.3 * s, "period_s": period}


def _turbo(rng: np.random.Generator, car: Car, drive: DrivePlan) -> AtStrength:
    spool = rng.uniform(1, 3)
    return lambda s: {"missing_share": min(0.95, 0.4 * s), "spool_s": spool}


def _hunting(rng: np.random.Generator, car: Car, drive: DrivePlan) -> AtStrength:
    hertz = rng.uniform(0.15, 0.8)
    return lambda s: {"amplitude_mps2": 0.15 * s, "frequency_hz": hertz}


def _pitch(rng: np.random.Generator, car: Car, drive: DrivePlan) -> AtStrength:
    hertz = rng.uniform(0.9, 1.8)
    return lambda s: {"amplitude": 1.0 * s, "frequency_hz": hertz}


EFFECTS: dict[str, Family] = {
    family.name: family
    for family in (
        Family("dead_time", "command", _fixed(delay_s=0.2), 4.0),
        Family(
            "command_hold", "command", _fixed(hold_fraction=0.08), 8.0, by_chance=True, suits=("steps", "stop_and_go")
        ),
        Family("dead_band", "command", _fixed(half_width_mps2=0.12), 6.0),
        Family("backlash", "command", _fixed(half_width_mps2=0.12), 5.0),
        Family("hand_over", "command", _fixed(pause_s=0.3), 4.0),
        Family("saturation", "actuator", _saturation, 5.0, suits=_ROUGH),
        Family("brake_throttle_asymmetry", "actuator", _asymmetry, 3.0),
        Family("second_order_actuator", "actuator", _second_order, 2.5),
        Family("rate_limit", "actuator", _rate_limit, 8.0, suits=_ROUGH),
        Family("speed_dependent_lag", "actuator", _speed_lag, 1.7, suits=_ROUGH),
        Family("speed_dependent_gain", "actuator", _speed_gain, 2.8),
        Family("gain_change", "actuator", _gain_change, 3.0),
        Family("gear_shift", "actuator", _gear_shift, 4.0, suits=_ROUGH),
        Family("driveline_oscillation", "body", _driveline, 5.0),
        Family("aerodynamic_drag", "body", _drag, 5.0),
        Family("viscous_drag", "body", _fixed(drag_per_s=0.012), 5.0),
        Family("road_grade", "body", _grade, 3.0),
        Family("constant_resistance", "body", _fixed(resistance_mps2=0.15), 5.0),
        Family("low_speed_creep", "body", _creep, 5.0, suits=("stop_and_go",)),
        Family("gust", "body", _gust, 4.0, by_chance=True),
        Family("sensor_lag", "sensor", _fixed(lag_s=0.2), 5.0),
        Family("sensor_bias", "sensor", _bias, 5.0),
        Family("sensor_scale", "sensor", _scale, 3.5),
        Family("speed_lag", "sensor", _fixed(lag_s=0.3), 3.0),
        Family("outliers", "sensor", _outliers, 6.0, by_chance=True),
    )
}
"""The 25 effects of the table, by name.

Example:
    >>> from benchmarks.blindtest import EFFECTS
    >>> from avtorch.gap import EFFECTS as KNOWN
    >>> sorted(EFFECTS) == sorted(KNOWN)  # the table, on either side
    True
"""

CALIBRATION: dict[str, Family] = {
    family.name: family
    for family in (
        Family("delay_jitter", "command", _jitter, 3.0),
        Family("stiction", "command", _fixed(breakaway_mps2=0.15), 6.0),
        Family("turbo_lag", "actuator", _turbo, 2.3),
        Family("hunting", "body", _hunting, 5.0),
        Family("pitch_coupling", "sensor", _pitch, 5.0),
        Family("wheel_slip", "sensor", _fixed(slip_s=0.15), 8.0),
    )
}
"""Families outside the table that may be used to calibrate `unknown`, by name.

Example:
    >>> from benchmarks.blindtest import CALIBRATION, EFFECTS, SEALED
    >>> bool(CALIBRATION.keys() & (EFFECTS.keys() | SEALED.keys()))  # no family is in two groups
    False
"""

SEALED: dict[str, Family] = {
    family.name: family
    for family in (
        Family("brake_blending", "actuator", _blending, 5.0),
        Family("brake_heat", "actuator", _heat, 8.0),
        Family("abs_cycling", "actuator", _abs, 2.5),
        Family("curve_drag", "body", _curves, 6.0),
        Family("vibration_aliasing", "sensor", _vibration, 8.0),
        Family("clock_drift", "sensor", _clock, 4.0),
        Family("tyre_radius", "sensor", _fixed(growth=0.03), 5.0),
    )
}
"""Families outside the table that are never used for calibration, by name.

Example:
    >>> from benchmarks.blindtest import SEALED, draw_case
    >>> case = draw_case(0, seed=1, mix={"outside": 1.0}, seconds=20.0)
    >>> case.names[0] in SEALED, case.truth_name
    (True, 'unknown')
"""


def family(name: str) -> Family:
    """The cause of that name. Raises `InputError` for an unknown one.

    Example:
        >>> from benchmarks.blindtest import family
        >>> family("command_hold").by_chance, family("dead_time").by_chance
        (True, False)
    """
    for group in (EFFECTS, CALIBRATION, SEALED):
        if name in group:
            return group[name]
    raise InputError(f"effect: found {name!r}, needs one of {', '.join([*EFFECTS, *CALIBRATION, *SEALED])}")
