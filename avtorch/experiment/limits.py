"""What a test track or a driver allows a manoeuvre to do."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

from avtorch.errors import InputError


@dataclass(frozen=True)
class Limits:
    """Speeds [m/s], commands [m/s²], length of the road [m] and duration [s] that a manoeuvre keeps to.

    Raises `InputError` where nothing could be driven.
    """

    speed_min: float = 1.0
    speed_max: float = 30.0
    accel_min: float = -3.0
    accel_max: float = 2.0
    road: float = 2000.0
    seconds: float = 60.0

    def __post_init__(self) -> None:
        for field in fields(self):
            if not math.isfinite(getattr(self, field.name)):
                raise InputError(f"{field.name}: found {getattr(self, field.name)}, needs a finite number")
        if not 0 <= self.speed_min <= self.speed_max - 5:
            raise InputError(
                f"speed_min, speed_max: found {self.speed_min:g} and {self.speed_max:g} m/s, "
                "needs 0 or more, and 5 m/s between them"
            )
        if self.accel_min > -0.3 or self.accel_max < 0.3:
            raise InputError(
                f"accel_min, accel_max: found {self.accel_min:g} and {self.accel_max:g} m/s², "
                "needs -0.3 or less and 0.3 or more"
            )
        for name, least, unit in (("road", 100.0, "m"), ("seconds", 20.0, "s")):
            if getattr(self, name) < least:
                raise InputError(f"{name}: found {getattr(self, name):g}, needs {least:g} {unit} or more")
