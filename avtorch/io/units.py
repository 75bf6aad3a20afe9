"""Units: as files and headers write them, what avtorch calls them, and their conversion to SI."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from avtorch.errors import InputError, printable
from avtorch.numeral import numeral

GRAVITY = 9.80665  # m/s^2, the standard value: "g" as a unit is defined by it
_MILE = 1609.344
_FOOT = 0.3048

_LENGTH = {"m": 1.0, "cm": 0.01, "mm": 0.001, "km": 1000.0, "ft": _FOOT}
_SPEED = {
    "m/s": 1.0, "km/h": 1 / 3.6, "mph": _MILE / 3600, "ft/s": _FOOT, "cm/s": 0.01, "mm/s": 0.001, "kn": 1852 / 3600,
}  # fmt: skip
_ACCEL = {
    "m/s2": 1.0, "g": GRAVITY, "mg": GRAVITY / 1000, "cm/s2": 0.01, "mm/s2": 0.001, "ft/s2": _FOOT,
    "km/h/s": 1 / 3.6, "mph/s": _MILE / 3600,
}  # fmt: skip
_JERK = {"m/s3": 1.0, "mps3": 1.0, "g/s": GRAVITY, "cm/s3": 0.01, "mm/s3": 0.001, "ft/s3": _FOOT}
_TIME = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0}
_GRADE = {"-": 1.0, "1": 1.0, "%": 0.01, "permille": 0.001}
_SHARE = {"-": 1.0, "1": 1.0, "%": 0.01}
_PRESSURE = {"Pa": 1.0, "kPa": 1e3, "MPa": 1e6, "bar": 1e5, "psi": 6894.757293168}
_TORQUE = {"Nm": 1.0, "kNm": 1000.0, "lbft": 1.3558179483314004}
_CURRENT = {"A": 1.0, "mA": 0.001}
# an angle is not converted by a factor: the grade is its tangent
_ANGLE: dict[str, Callable[[NDArray], NDArray]] = {"rad": np.tan, "deg": lambda x: np.tan(np.radians(x))}

_UNITS: dict[str, dict[str, float]] = {
    "time": _TIME,
    "accel_cmd": _ACCEL,
    "accel": _ACCEL,
    "speed": _SPEED,
    "jerk": _JERK,
    "spacing": _LENGTH,
    "lead_speed": _SPEED,
    "lead_accel": _ACCEL,
    "grade": _GRADE,
    "throttle": _SHARE,
    "brake": _SHARE | _PRESSURE | _TORQUE,
    "torque": _TORQUE,
    "current": _CURRENT,
    "speed_cmd": _SPEED,
}
SI = {
    **{"time": "s", "accel_cmd": "m/s²", "accel": "m/s²", "speed": "m/s", "jerk": "m/s³", "spacing": "m"},
    **{"lead_speed": "m/s", "lead_accel": "m/s²", "grade": "-", "throttle": "-", "brake": "-", "torque": "Nm"},
    **{"current": "A", "speed_cmd": "m/s"},
}
"""The unit in which a log holds each signal; a brake may be a pressure [Pa] or a torque [Nm] instead of a share."""


def to_si(signal: str, unit: str) -> Callable[[NDArray], NDArray]:
    """The conversion of ``signal`` from ``unit`` to SI: a name such as ``km/h``, ``g``, ``ms`` or ``cm/s²``, or a bare
    factor such as ``-1`` for a sensor mounted backwards.

    Raises InputError for a signal that has no unit and for a unit that is not known for this signal.
    """
    known, shown = _UNITS.get(signal), f"{signal}={printable(unit, 40)}"
    if known is None:
        raise InputError(f"unit {shown}: {signal} takes no unit; signals with one: {', '.join(_UNITS)}")
    name = _plain(unit)
    name = name if name in known else unit_named(unit) or name
    if name in known:
        return _scaled(known[name])
    if signal == "grade" and name in _ANGLE:
        return _ANGLE[name]
    try:
        size = numeral(name)
    except ValueError:
        size = math.nan
    if not 1e-12 <= abs(size) <= 1e12:  # NaN, too
        also = (*known, *(_ANGLE if signal == "grade" else ()))
        raise InputError(f"unit {shown}: not known for {signal}; known: {', '.join(also)}, or a factor to SI")
    return _scaled(size)


def factor(signal: str, unit: str) -> float:
    """Size of a unit in SI."""
    return float(to_si(signal, unit)(np.ones(1))[0])


def _scaled(size: float) -> Callable[[NDArray], NDArray]:
    # dividing keeps 50.4 km/h = 14 m/s exact where multiplying by the rounded 1/3.6 would not
    if size == 1.0:
        return lambda x: x
    inverse = round(1 / size, 9)
    if abs(inverse * size - 1) < 1e-15:
        return lambda x: x / inverse
    return lambda x: x * size


UNITS: dict[str, tuple[str, ...]] = {
    "m/s": ("m/s", "mps", "ms-1", "m s-1", "meterpersecond", "meters/second", "meter/s"),
    "km/h": ("km/h", "kmh", "kph", "kmph", "km/hr", "kmh-1", "kilometersperhour"),
    "mph": ("mph", "mi/h", "miles/h"),
    "ft/s": ("ft/s", "fps"),
    "cm/s": ("cm/s", "cmps"),
    "mm/s": ("mm/s", "mmps"),
    "kn": ("kn", "kt", "kts", "knots"),
    "m/s2": ("m/s2", "m/s/s", "mps2", "mpss", "ms-2", "m/sec2", "m/ss", "ms2"),
    "g": ("g", "gee", "gs"),
    "mg": ("mg",),
    "cm/s2": ("cm/s2", "gal"),
    "mm/s2": ("mm/s2",),
    "ft/s2": ("ft/s2",),
    "s": ("s", "sec", "secs", "second", "seconds"),
    "ms": ("ms", "msec", "msecs", "millis", "milliseconds"),
    "us": ("us", "usec", "micros", "microseconds"),
    "ns": ("ns", "nsec", "nsecs", "nanos", "nanosec", "nanoseconds"),
    "min": ("min", "minutes"),
    "h": ("h", "hours"),
    "m": ("m", "meter", "meters", "metres"),
    "cm": ("cm",),
    "mm": ("mm",),
    "km": ("km",),
    "ft": ("ft", "feet"),
    "%": ("%", "pct", "percent", "perc"),
    "deg": ("deg", "degree", "degrees"),
    "rad": ("rad", "radian", "radians"),
    "bar": ("bar",),
    "Pa": ("pa",),
    "kPa": ("kpa",),
    "MPa": ("mpa",),
    "psi": ("psi",),
    "Nm": ("nm", "n.m", "n*m"),
    "A": ("a", "ampere", "amps"),
    "rpm": ("rpm", "1/min"),
}
"""Units as headers write them, by the name that avtorch uses."""
_NAMED = {form: unit for unit, forms in UNITS.items() for form in forms}


def unit_named(text: str) -> str | None:
    """The unit that `text` writes, in avtorch's spelling, or None."""
    plain = _plain(text.strip().strip("[]()<>{}")).lower()
    return _NAMED.get(plain) or _NAMED.get(plain.replace(" ", ""))


def _plain(text: str) -> str:
    """In letters of ASCII, without a mark of a power."""
    for mark, written in (("²", "2"), ("³", "3"), ("^", ""), ("**", ""), ("µ", "u"), ("μ", "u"), ("°", "deg")):
        text = text.replace(mark, written)
    return text.strip()


def stated_unit(signal: str, text: str) -> str | None:
    """The unit that a file states for a signal, where it is one that the signal can have; None otherwise."""
    unit = unit_named(text)
    try:
        to_si(signal, unit or "")
    except InputError:
        return None
    return unit
