"""Sizes of causes that were rightly named, against those that the reference vehicle was given.

Only a part of a budget that is a cause of the case has a size that can be wrong; a wrong name is counted elsewhere. The
two sides share no code, so `SAME` says for which effects a number means the same on both.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from benchmarks.blindtest.answers import Answered

SIZE_WITHIN = 0.25
"""A size is right within this share of what was put in."""


def _sum(found: float, before: float, put_in: float) -> float | None:
    return (found - before) / put_in


def _ratio(found: float, before: float, put_in: float) -> float | None:
    """Factors multiply: compared as logarithms, so that a gain of 0.65 is as far from 1 as one of 1/0.65."""
    return math.log(found / before) / math.log(put_in) if min(found, before) > 0 else None


def _squares(found: float, before: float, put_in: float) -> float | None:
    """Independent disturbances add in squares."""
    return math.sqrt(max(found**2 - before**2, 0.0)) / put_in


def _stricter(found: float, before: float, put_in: float) -> float | None:
    """Of two limits only the stricter one is seen."""
    return found / min(before, put_in)


SIZE_OF: Mapping[str, tuple[str, float, Callable[[float, float, float], float | None]]] = {
    "dead_time": ("delay_s", 0.0, _sum),
    "dead_band": ("half_width_mps2", 0.0, _sum),
    "backlash": ("half_width_mps2", 0.0, _sum),
    "brake_throttle_asymmetry": ("brake_gain_ratio", 1.0, _ratio),
    "gain_change": ("gain_ratio", 1.0, _ratio),
    "speed_dependent_gain": ("gain_slope", 0.0, _sum),
    "saturation": ("accel_max_mps2", math.inf, _stricter),
    "constant_resistance": ("resistance_mps2", 0.0, _sum),
    "aerodynamic_drag": ("drag_per_m", 0.0, _sum),
    "road_grade": ("grade_rms", 0.0, _squares),
    "low_speed_creep": ("creep_mps2", 0.0, _sum),
    "gust": ("sd_mps2", 0.0, _squares),
    "sensor_bias": ("bias_mps2", 0.0, _sum),
    "sensor_scale": ("scale", 1.0, _ratio),
    "sensor_lag": ("lag_s", 0.0, _sum),
    "outliers": ("fraction", 0.0, _sum),
}
"""By effect: the parameter that is its size, its value without the effect, and how a second one adds to a first.

A diagnosis gives the size of outliers in units of a noise that nobody knows, so their share is compared instead.
"""

_OTHERWISE: frozenset[str] = frozenset({"speed_dependent_gain", "road_grade", "low_speed_creep"})
"""Whose size can be put in front of a log, but means something else in the reference vehicle.

Its gain is a flattened map about a speed that is typical of the manoeuvre, and not a line about the drive's mean speed.
Its road's size is that of all roads of its kind, not of the one driven. Its creep falls with the square of speed, so a
fit by the table's equation is another number. The same holds for its lag that depends on speed, and for its gear
shifts, in which a clutch opens and closes by degrees; these are not in `SIZE_OF`.
"""


def _quotient(found: float, without: float, given: float) -> float:
    return found / given


SAME: Mapping[str, tuple[str, float, Callable[[float, float, float], float | None]]] = {
    **{effect: size for effect, size in SIZE_OF.items() if effect not in _OTHERWISE},
    "command_hold": ("hold_fraction", 0.0, _quotient),
    "second_order_actuator": ("natural_frequency_radps", math.inf, _quotient),
    "hand_over": ("pause_s", 0.0, _quotient),
    "viscous_drag": ("drag_per_s", 0.0, _quotient),
    "speed_lag": ("lag_s", 0.0, _quotient),
    "rate_limit": ("jerk_max_mps3", math.inf, _quotient),
    "driveline_oscillation": ("amplitude", 0.0, _quotient),
}
"""By effect: the parameter that is its size on both sides, its value without the effect, and how a size that was found
compares with the true one (1: as it is)."""


@dataclass(frozen=True)
class FoundSize:
    """The size of one rightly named part over the true one, `ratio`; `covered`: whether its 90 % interval holds that.

    None where the answer has no such number, or no interval.
    """

    effect: str
    ratio: float | None
    covered: bool | None

    @property
    def right(self) -> bool | None:
        """Whether it is within a quarter of the truth."""
        return None if self.ratio is None else abs(self.ratio - 1) <= SIZE_WITHIN + 1e-12


def found_sizes(row: Answered) -> list[FoundSize]:
    """A size for each part of the budget, causes of chance among them, that is named, true, and in `SAME`."""
    if row.budget is None:
        return []
    true = set(row.truth.split("+"))
    parts = [part for part in (*row.budget.parts, *row.budget.chance) if part.named and part.name in true]
    return [
        _size(part.name, part.parameters, row.true_parameters[part.name])
        for part in parts
        if part.name in SAME and part.name in row.true_parameters
    ]


def _size(effect: str, found: Mapping[str, Mapping[str, float]], true: Mapping[str, float]) -> FoundSize:
    parameter, without, relative = SAME[effect]
    quantity, given = found.get(parameter, {}), float(true[parameter])
    ratio = relative(float(quantity["mean"]), without, given) if "mean" in quantity else None
    covered = quantity["q05"] <= given <= quantity["q95"] if {"q05", "q95"} <= quantity.keys() else None
    return FoundSize(effect, ratio, covered)
