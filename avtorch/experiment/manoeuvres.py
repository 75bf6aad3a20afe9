"""Manoeuvres for a test track or a driver in the loop: commands over time, within limits.

Each begins and ends with some seconds without a command, and returns to the speed it began at. Steps show delay, lag
and order; both pedals to the limit show saturation and asymmetry; small reversals show a dead band or play; ramps show
a limited jerk; holds show whatever depends on speed; a sweep of frequencies shows the modes.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, fields, replace

import numpy as np
from scipy.signal import chirp

from avtorch.arrays import FloatArray
from avtorch.errors import InputError
from avtorch.gap.result.log_facts import LogFacts

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
        for limit in fields(self):
            value = getattr(self, limit.name)
            if limit.name != "source" and not math.isfinite(value):
                raise InputError(f"{limit.name}: found {value}, needs a finite number")
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


Pattern = Callable[[FloatArray], FloatArray]

_BEFORE_S, _AFTER_S = 3.0, 2.0
_SPEEDS = (0.2, 0.5, 0.8)  # of the span between slowest and fastest
_SHORTEST_HOLD_S = 1.5
_GAIN_MPS = 4.0  # by one push of a pedal
# for a narrow range of speeds [m/s]: commands [m/s²] and speed gained by a push [m/s] that fit, as shares of the range
_PARTS_PER_S = 1 / 6
_SWEPT_PER_S = 0.06  # of a sweep that begins at 0.05 Hz
_PUSH = 0.2


@dataclass(frozen=True, eq=False)
class Manoeuvre:
    """`command` (row,) [m/s²] at `time` (row,) [s], and the `speed` (row,) [m/s] that is expected of the car."""

    name: str
    time: FloatArray = field(repr=False)
    command: FloatArray = field(repr=False)
    speed: FloatArray = field(repr=False)

    @property
    def metres(self) -> float:
        """Road that it takes."""
        return float(np.trapezoid(self.speed, self.time))

    @property
    def effort(self) -> float:
        """Root mean square of the command [m/s²]: how hard it is on driver and car."""
        return float(np.sqrt(np.mean(self.command**2)))

    def within(self, limits: Limits) -> bool:
        """Whether it stays within the limits throughout."""
        slow, fast = float(self.speed.min()), float(self.speed.max())
        low, high = float(self.command.min()), float(self.command.max())
        return (
            limits.speed_min - 1e-6 <= slow
            and fast <= limits.speed_max + 1e-6
            and limits.accel_min - 1e-9 <= low
            and high <= limits.accel_max + 1e-9
            and self.metres <= limits.road
            and self.time[-1] <= limits.seconds + 1e-9
        )

    def trimmed(self, gain: float, start: float | None = None) -> Manoeuvre:
        """The same with an extra change of speed of `gain` [m/s] spread over its commands, most over the gentlest.

        The speed expected is then that of a perfect car from `start` [m/s] on.
        """
        dt = float(self.time[1] - self.time[0])
        active = (self.time >= _BEFORE_S - 1e-9) & (self.time <= self.time[-1] - _AFTER_S + 1e-9)
        limit = np.where(self.command < 0, self.command.min(), self.command.max())
        # none at full pedal, and no new jumps
        gentle = np.where(active, 1.0 - (self.command / np.where(limit == 0, 1.0, limit)) ** 2, 0.0)
        command = self.command + gain / (gentle.sum() * dt) * gentle
        begin = float(self.speed[0]) if start is None else start
        return replace(self, command=command, speed=begin + np.concatenate([[0.0], np.cumsum(command[:-1]) * dt]))


def library(limits: Limits | None = None, *, rate_hz: float = 20.0) -> tuple[Manoeuvre, ...]:
    """All manoeuvres that a perfect car could drive within the limits, each as long as they allow.

    Example:
        >>> from avtorch.experiment import Limits, library
        >>> names = [manoeuvre.name for manoeuvre in library(Limits(road=1000.0))]
        >>> len(names) == len(set(names)), len(names) > 3
        (True, True)
    """
    given = Limits() if limits is None else limits
    return tuple(m for m in _all(given, rate_hz) if m.within(given))


def _all(limits: Limits, rate_hz: float) -> Iterator[Manoeuvre]:
    low = max(limits.speed_min, 0.5)
    span, push, brake = limits.speed_max - low, limits.accel_max, -limits.accel_min
    both = min(push, brake, _PARTS_PER_S * span)
    gain, swept = min(_GAIN_MPS, _PUSH * span), min(0.5 * both, _SWEPT_PER_S * span)
    step = min(1.0, _PUSH * span)
    digits = 0 if span >= 10 else 1
    time = np.arange(math.floor(limits.seconds * rate_hz + 1e-9) + 1) / rate_hz
    whole = float(time[-1]) - _BEFORE_S - _AFTER_S

    def made(name: str, start: float, pattern: Pattern, period: float = whole) -> Iterator[Manoeuvre]:
        lasts = whole // period * period
        if lasts > 0:
            yield _made(name, time, start, pattern, lasts)

    for share in _SPEEDS:
        v = low + share * span
        at = f"at {v:.{digits}f} m/s"
        for size in (0.25 * both, both):
            for hold in (2.0, 5.0):
                name = f"steps of {size:.2g} m/s² held {hold:g} s {at}"
                # every level alternates with rest, and each sign comes first once
                levels = size * np.array([1.0, 0.0, -1.0, 0.0, -1.0, 0.0, 1.0, 0.0])
                yield from made(name, v, _stages(levels, [hold] * 8), 4 * hold)
        name = f"pedals to {push:.2g} and {-brake:.2g} m/s² {at}"
        # one in full after the other, then half of each, for as long as restores the speed
        on, off = gain / push, gain / brake
        lasts = [on, off, 1.0, 2 * off, 2 * on, 1.0]
        yield from made(name, v, _stages([push, -brake, 0.0, -0.5 * brake, 0.5 * push, 0.0], lasts), sum(lasts))
        yield from made(f"sweep of {swept:.2g} m/s², 0.05 to 2 Hz, {at}", v, lambda t: _sweep(t, swept))
        yield from made(f"small reversals {at}", v, lambda t: _reversals(t, whole), 6.0)
        for slope in (0.4, 1.5):
            name = f"ramps of {slope:g} m/s³ {at}"
            yield from made(name, v, lambda t, s=slope: _ramps(t, s, both), 4 * both / slope)
    for size in (0.3 * both, 0.7 * both):
        for top in (0.5, 0.75, 0.98):
            v = low + top * span
            each = (v - low - step) / 3 / size
            rest = whole / 6 - each
            if rest >= _SHORTEST_HOLD_S:
                name = f"holds at speeds from {low + step:.{digits}f} to {v:.{digits}f} m/s, {size:.2g} m/s² between"
                # up in three stages and down in three
                pattern = _stages([size, 0.0] * 3 + [-size, 0.0] * 3, [each, rest] * 6)
                yield from made(name, low + step, pattern)
    for size in (0.5 * both, both):
        # from walking pace up and back, and some seconds of rolling
        each = 2 * gain / size
        pattern = _stages([size, 0.0, -size, 0.0], [each, 1.0, each, 4.0])
        yield from made(f"slow and go, {size:.2g} m/s²", low + 0.5 * step, pattern, 2 * each + 5.0)


def _made(name: str, time: FloatArray, start: float, pattern: Pattern, lasts: float) -> Manoeuvre:
    t = time - _BEFORE_S
    active = (t >= -1e-9) & (t < lasts - 1e-9)
    u = np.zeros_like(time)
    u[active] = pattern(t[active])
    made = Manoeuvre(name, time, u, np.full_like(time, start))
    dt = time[1] - time[0]
    return made.trimmed(-float(u.sum() * dt), start)


def _stages(levels: Sequence[float] | FloatArray, lasts: Sequence[float]) -> Pattern:
    """Commands [m/s²] one after the other, each for as long as it lasts [s], repeating."""
    ends, held = np.cumsum(lasts), np.asarray(levels, dtype=float)
    return lambda t: held[np.searchsorted(ends, t % ends[-1] + 1e-9, side="right").clip(0, len(ends) - 1)]


def _sweep(t: FloatArray, size: float) -> FloatArray:
    return size * np.asarray(chirp(t, 0.05, float(t[-1]), 2.0, method="logarithmic", phi=-90))


def _reversals(t: FloatArray, whole: float) -> FloatArray:
    """Steps smaller than a dead band or play, ever larger."""
    sizes = np.array([0.05, 0.1, 0.15, 0.2, 0.3, 0.4])
    part = np.minimum((t // 6.0 * 6.0 / whole * len(sizes)).astype(int), len(sizes) - 1)
    return sizes[part] * np.array([1.0, -1.0, -1.0, 1.0])[(t / 1.5 + 1e-9).astype(int) % 4]


def _ramps(t: FloatArray, slope: float, top: float) -> FloatArray:
    phase = (t * slope / (4 * top)) % 1.0
    return 4 * top * np.where(phase < 0.25, phase, np.where(phase < 0.75, 0.5 - phase, phase - 1.0))
