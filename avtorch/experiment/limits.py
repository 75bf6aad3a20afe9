"""What a test track or a driver allows a manoeuvre to do."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

from avtorch.errors import InputError
from avtorch.gap.result.diagnosis import LogFacts

LEAST_SPAN_MPS = 1.5
_LEAST_MPS2 = 0.3
_BEYOND = 0.05
"""Limits taken from a log extend beyond what was driven by this share, at either end."""


@dataclass(frozen=True)
class Limits:
    """Speeds [m/s], commands [m/s²], length of the road [m] and duration [s] that a manoeuvre keeps to.

    `source`: where they come from, in words. Raises `InputError` where no manoeuvre could be driven.

    Example:
        >>> from avtorch.experiment import Limits, library
        >>> track = Limits(speed_max=15.0, road=500.0, seconds=30.0)
        >>> all(manoeuvre.within(track) for manoeuvre in library(track))
        True
    """

    speed_min: float = 1.0
    speed_max: float = 30.0
    accel_min: float = -3.0
    accel_max: float = 2.0
    road: float = 2000.0
    seconds: float = 60.0
    source: str = "as given"

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if field.name != "source" and not math.isfinite(value):
                raise InputError(f"{field.name}: found {value}, needs a finite number")
        whence = "" if self.source == "as given" else f" ({self.source})"
        # a sum in floating point may miss by its last digits
        if not 0 <= self.speed_min <= self.speed_max - LEAST_SPAN_MPS + 1e-9:
            raise InputError(
                f"speed_min, speed_max: found {self.speed_min:g} and {self.speed_max:g} m/s{whence}, "
                f"needs 0 or more, and {LEAST_SPAN_MPS:g} m/s between them"
            )
        if self.accel_min > -_LEAST_MPS2 or self.accel_max < _LEAST_MPS2:
            raise InputError(
                f"accel_min, accel_max: found {self.accel_min:g} and {self.accel_max:g} m/s²{whence}, "
                f"needs {-_LEAST_MPS2:g} or less and {_LEAST_MPS2:g} or more"
            )
        for name, least, unit in (("road", 100.0, "m"), ("seconds", 20.0, "s")):
            if getattr(self, name) < least:
                raise InputError(f"{name}: found {getattr(self, name):g}, needs {least:g} {unit} or more")

    @classmethod
    def of_log(cls, log: LogFacts, **given: float | None) -> Limits:
        """The range that the car drove in a log, extended by a twentieth at either end; `given` limits (not None)
        override it.

        At least 1.5 m/s and 0.3 m/s² either way, the least that any manoeuvre needs. Without a speed in the log the
        limits are those of a usual car. Raises `InputError` where no manoeuvre could be driven.
        """
        chosen = {name: value for name, value in given.items() if value is not None}
        found: dict[str, float] = {}
        if log.speeds is not None:
            low, high = _wider(log.speeds, LEAST_SPAN_MPS)
            found |= {"speed_min": max(low, 0.0), "speed_max": max(high, LEAST_SPAN_MPS)}
        if log.commands is not None:
            low, high = _wider(log.commands, 0.0)
            found |= {"accel_min": min(low, -_LEAST_MPS2), "accel_max": max(high, _LEAST_MPS2)}
        source = "from the log, where not given" if chosen else "from the log"
        if log.speeds is None and not {"speed_min", "speed_max"} <= set(chosen):
            source += ", speeds assumed as it has none"
        return cls(**(found | chosen), source=source)  # pyright: ignore[reportArgumentType]

    def __str__(self) -> str:
        speeds = f"{self.speed_min:.2g} to {self.speed_max:.3g} m/s"
        commands = f"{self.accel_min:.2g} to {self.accel_max:.2g} m/s²"
        return f"{speeds}, {commands}, {self.road:.0f} m and {self.seconds:.0f} s ({self.source})"


def _wider(ends: tuple[float, float], least: float) -> tuple[float, float]:
    low, high = ends
    more = max(_BEYOND * (high - low), 0.5 * (least - (high - low)))
    return low - more, high + more
