"""Units of the parameters of either form."""

from __future__ import annotations

UNITS = {
    "T_L": "s",
    "K_L": "1",
    "sigma": "m/s^3",
    "process_noise": "m/s^2/sqrt(s)",
    "road_noise": "m/s/sqrt(s)",
    "speed_noise": "m/s",
    "accel_noise": "m/s^2",
    "coloured_sd": "m/s^2",
    "coloured_time": "s",
}
"""By parameter, as ArviZ and xarray write units."""


def shown_unit(name: str) -> str:
    """A parameter's unit as tables show it: ``m/s²``, ``-`` for none; empty for a parameter that is not known."""
    unit = UNITS.get(name, "")
    return "-" if unit == "1" else unit.replace("^2", "²").replace("^3", "³").replace("sqrt(s)", "√s")
