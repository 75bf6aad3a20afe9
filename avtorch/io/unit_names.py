"""Units as files and headers write them, and what avtorch calls them."""

from __future__ import annotations

from avtorch.errors import InputError
from avtorch.io.units import SIGNALS_WITH_UNIT, to_si

UNITS: dict[str, tuple[str, ...]] = {
    "m/s": ("m/s", "mps", "ms-1", "m s-1", "ms^-1", "meterpersecond", "meters/second", "meter/s"),
    "km/h": ("km/h", "kmh", "kph", "kmph", "km/hr", "kmh-1", "kilometersperhour"),
    "mph": ("mph", "mi/h", "miles/h"),
    "ft/s": ("ft/s", "fps"),
    "cm/s": ("cm/s", "cmps"),
    "mm/s": ("mm/s", "mmps"),
    "kn": ("kn", "kt", "kts", "knots"),
    "m/s2": ("m/s2", "m/s^2", "m/s/s", "mps2", "mpss", "mps^2", "ms-2", "ms^-2", "m/sec2", "m/s**2", "m/ss", "ms2"),
    "g": ("g", "gee", "gs"),
    "mg": ("mg",),
    "cm/s2": ("cm/s2", "cm/s^2", "gal"),
    "mm/s2": ("mm/s2", "mm/s^2"),
    "ft/s2": ("ft/s2", "ft/s^2"),
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
    plain = text.strip().strip("[]()<>{}").strip().lower()
    plain = plain.replace("²", "2").replace("³", "3").replace("µ", "u").replace("μ", "u").replace("°", "deg")
    return _NAMED.get(plain) or _NAMED.get(plain.replace(" ", ""))


def stated_unit(signal: str, text: str) -> str | None:
    """The unit that a file states for a signal, where it is one that the signal can have; None otherwise."""
    unit = unit_named(text)
    if unit is None or signal not in SIGNALS_WITH_UNIT:
        return None
    try:
        to_si(signal, unit)
    except InputError:
        return None
    return unit
