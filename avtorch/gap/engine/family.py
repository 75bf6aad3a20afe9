"""Families of causes: a cause is where it acts before it has a name."""

from __future__ import annotations

from avtorch.gap.engine.force_map import CURVES

FAMILIES = {
    "force map": CURVES,
    "dynamics": (
        *("dead_time", "backlash", "hand_over", "second_order_actuator", "rate_limit", "speed_dependent_lag"),
        *("gear_shift", "driveline_oscillation"),
    ),
    "place": ("road_grade",),
    "time": ("gain_change",),
    "sensor": ("sensor_lag", "sensor_bias", "sensor_scale", "speed_lag"),
    "chance": ("gust", "outliers", "command_hold"),
}
"""Names of the effects of each."""
FORMS = {
    "linear": ("dynamics", "other linear dynamics"),
    "sided": ("dynamics", "lags that depend on the sign of the command"),
    "cycle": ("dynamics", "a force that swings at one frequency"),
    "map": ("force map", "a force map"),
    "sensor": ("sensor", "other dynamics of a reading"),
    "gain": ("time", "a gain that wanders"),
    "braking": ("time", "a gain of the brakes that wanders"),
    "delay": ("time", "a delay that wanders"),
    "rough_braking": ("chance", "a random force while braking"),
    "rough_driving": ("chance", "a random force while driving"),
}
"""Family of each free form, and what it is."""
OWN = "own"
"""Family of a user's effect, of which the table knows nothing."""


def family_of(name: str) -> str:
    """The family of an effect by the table's name, or of a free form."""
    if name in FORMS:
        return FORMS[name][0]
    return next((family for family, names in FAMILIES.items() if name in names), OWN)
