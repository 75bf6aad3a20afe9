"""Values of a log that are certainly wrong raise here. ``quality`` notes those that are only doubtful.

A cell nothing can be made of, torn, a sensor's code for "no value", a stamp that jumps, costs its row. Many in one
column are another matter: then the column is not what it was taken for, and the first of them is the error.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from avtorch.arrays import BoolArray, FloatArray
from avtorch.errors import InputError
from avtorch.io.units import GRAVITY, factor

SPANS_S = (1.0, 4.0)  # the short one suits brisk drives, the long one averages more sensor noise
MIN_SPANS = 8
LATER_S = tuple(np.arange(1.1, 2.51, 0.1))
"""Delays [s] of a response later than a command is usually followed, up to 2.5 s."""
# a late car on a noisy manoeuvre of 30 s: 0.69 at its own delay, and -0.95 half a period earlier
_MAY_BE = 0.5


class Scale(NamedTuple):
    """``slope`` [-]: change of the first signal per integral of the second; ``correlation`` of the two; ``change``:
    standard deviation of the first one's changes, in its unit per second; ``spans``: how many separate ones;
    ``constant``: what the first one changes by beyond the slope, in its unit per second, and its standard error ``sd``.
    """

    slope: float
    correlation: float
    change: float
    spans: float
    constant: float
    sd: float

    @property
    def factor(self) -> float | None:
        """The factor by which the first signal surely changes more, or less, than the second implies; None where that
        may be 1.

        Noise in the second signal lowers the slope, noise in the first the slope of the inverse relation: the true
        factor lies between the two (Frisch 1934), give or take three standard errors.
        """
        r = self.correlation
        if r <= 0:
            return None
        error = 3.0 * math.sqrt(max(1 - r**2, 0.0) / self.spans) / r
        if self.slope * (1 - error) <= 1 <= self.slope / r**2 * (1 + error):
            return None
        return self.slope / r


def scale_between(
    time: NDArray, parts: Sequence[slice], level: NDArray, rate: NDArray, *, delays: Sequence[float] = (0.0,)
) -> Scale | None:
    """Compare the changes of ``level`` over a span with the integral of ``rate`` over the same span, both ``(time,)``.

    ``parts`` are the stretches that may be used; of ``delays`` [s] of the response and of SPANS_S, the pair of best
    correlation counts. None where there are fewer than MIN_SPANS separate spans or one of the two signals does not
    move: the scale is then unknown.
    """
    totals = [(time[x], level[x], integral(time[x], rate[x])) for x in parts if len(time[x]) > 2]
    found = (_compare(totals, span, delay) for span in SPANS_S for delay in delays)
    return max((x for x in found if x is not None), key=_rank, default=None)


def integral(time: NDArray, rate: NDArray) -> FloatArray:
    """The integral of ``rate`` from the first row on, both ``(time,)``; steps of over a second, gaps, count as one."""
    return np.concatenate([[0.0], np.cumsum(0.5 * (rate[1:] + rate[:-1]) * np.clip(np.diff(time), 0.0, 1.0))])


def late_response(time: NDArray, parts: Sequence[slice], level: NDArray, rate: NDArray) -> tuple[Scale | None, bool]:
    """For a response that looks inverted: the best one at LATER_S, None where unknown, and whether it may be the true
    one. Arguments as of `scale_between`.

    For a command that returns with the other sign after half a period, a late response cannot be distinguished from an
    inverted one: an inverted response counts only where one of the right sign, with up to 2.5 s of delay and lag, is
    known to correlate far less. Short stretches know the smaller delays only; as the largest is unknown then, it may be
    the car's.
    """
    later = scale_between(time, parts, level, rate, delays=LATER_S)
    if later is None or scale_between(time, parts, level, rate, delays=LATER_S[-1:]) is None:
        return None, True
    return later, later.correlation >= _MAY_BE


def _compare(totals: list[tuple[NDArray, NDArray, NDArray]], span: float, delay: float) -> Scale | None:
    changes, integrals, spans = [], [], 0.0
    for t, x, total in totals:
        starts = np.arange(t[0] + delay, t[-1] - span, span / 4)
        if len(starts):
            spans += (t[-1] - t[0] - delay) / span
            changes.append(np.interp(starts + span, t, x) - np.interp(starts, t, x))
            integrals.append(np.interp(starts + span - delay, t, total) - np.interp(starts - delay, t, total))
    if spans < MIN_SPANS:
        return None
    change, total = np.concatenate(changes), np.concatenate(integrals)
    sx, sy = float(change.std()), float(total.std())
    # a constant signal leaves rounding only
    if sx <= 1e-9 * (1 + np.abs(change).max()) or sy <= 1e-9 * (1 + np.abs(total).max()):
        return None
    r = float(np.mean((change - change.mean()) * (total - total.mean())) / (sx * sy))
    slope = r * sx / sy
    left = sx * math.sqrt(max(1 - r**2, 0.0)) / span
    sd = left / math.sqrt(spans) * math.sqrt(1 + (float(total.mean()) / sy) ** 2)
    return Scale(slope, r, sx / span, spans, float(change.mean() - slope * total.mean()) / span, sd)


def _rank(found: Scale) -> tuple[bool, float]:
    # a periodic drive correlates as strongly, with the other sign, half a period off: the agreeing sign goes first
    return found.correlation > 0.5, abs(found.correlation)


MOST_BAD = 0.05
"""Share of the rows that may be left out for one signal."""
_TOLD = 3
_APART = 5.0  # times the range of the others


class BadRows:
    """Rows of a log of `rows` rows that are left out, with what is wrong with them."""

    def __init__(self, rows: int) -> None:
        self.kept: BoolArray = np.ones(rows, bool)
        self._words: dict[int, str] = {}

    def leave_out(self, faults: Mapping[int, str]) -> None:
        """Rows with a fault in one signal, by number from 0; InputError with the first one where there are too many."""
        if not faults:
            return
        if len(faults) > MOST_BAD * len(self.kept):
            raise InputError(faults[min(faults)])
        self.kept[list(faults)] = False
        for row, words in faults.items():
            self._words.setdefault(row, words)

    def remarks(self) -> list[str]:
        """The first of them in words, and how many there are."""
        words = [self._words[row] for row in sorted(self._words)]
        told = [f"{text}; the row is left out" for text in words[:_TOLD]]
        if len(words) > _TOLD:
            told.append(f"{len(words) - _TOLD} more rows are left out for a cell that is no valid value")
        return told


def codes(values: FloatArray) -> BoolArray:
    """Values (row,) that lie farther from all others than five times their range: a few, such as -999 for "none".

    They are known without a unit, for which a code of 2 % of the rows would otherwise decide.
    """
    known = np.sort(values[np.isfinite(values)])
    few = int(MOST_BAD * len(known))
    out = np.zeros(len(values), bool)
    if not few:
        return out
    inner = known[few : len(known) - few]
    for tail, end, sign in ((known[: few + 1], inner[-1], 1.0), (known[len(known) - few - 1 :][::-1], inner[0], -1.0)):
        # from the outermost value inwards: how far the next is, and what the rest of the range is from there
        gap, rest = sign * np.diff(tail), np.abs(end - tail[1:])
        apart = np.flatnonzero((gap > _APART * rest) & (rest > 0))
        if len(apart):
            out |= sign * values <= sign * tail[apart[-1]]
    return out


def out_of_order(time: FloatArray) -> BoolArray:
    """Rows (row,) to leave out of `time` [s] so that the others rise: the fewest."""
    ends: list[float] = []  # the least last stamp of a rising run of each length, and its row
    rows: list[int] = []
    before = np.full(len(time), -1)
    for row, stamp in enumerate(time.tolist()):
        if stamp != stamp:
            continue
        length = bisect_left(ends, stamp)
        if length < len(ends) and ends[length] == stamp:
            continue  # of rows with one stamp the first stays
        before[row] = rows[length - 1] if length else -1
        if length == len(ends):
            ends.append(stamp)
            rows.append(row)
        else:
            ends[length], rows[length] = stamp, row
    out = np.ones(len(time), bool)
    row = rows[-1] if rows else -1
    while row >= 0:
        out[row] = False
        row = int(before[row])
    return out & ~np.isnan(time)


def time_faults(time: FloatArray, drive: FloatArray, where: Callable[[int], str]) -> dict[int, str]:
    """What is wrong with rows of `time` (row,) [s]: beyond any clock's count, or not rising within their drive."""
    faults = {
        row: f"{where(row)}: found {time[row]:.4g} s, a stamp so far from zero that float64 cannot resolve the rows; "
        "needs stamps within 1e9 s of the first"
        for row in np.flatnonzero(np.abs(time) > _BEYOND_CLOCKS).tolist()
    }
    time = np.where(np.abs(time) > _BEYOND_CLOCKS, np.nan, time)
    cuts = [0, *(np.flatnonzero(np.diff(drive) != 0) + 1).tolist(), len(time)]
    for first, last in pairwise(cuts):
        part = time[first:last]
        known = np.flatnonzero(~np.isnan(part))
        if not (np.diff(part[known]) <= 0).any():
            continue
        for row in np.flatnonzero(out_of_order(part)).tolist():
            earlier = known[known < row]
            since = float(part[earlier[-1]]) if len(earlier) else -np.inf
            faults[first + row] = f"{where(first + row)}: {_course(since, part[row])}; time must rise from row to row"
    return faults


def check_time(time: FloatArray, where: Callable[[int], str]) -> None:
    """Raise InputError at the first row of one drive that `time_faults` has."""
    faults = time_faults(time, np.zeros(len(time)), where)
    if faults:
        raise InputError(faults[min(faults)])


def _course(since: float, stamp: float) -> str:
    if stamp == since:
        return f"repeats {stamp:.16g} s"
    return f"goes back from {since:.16g} s to {stamp:.16g} s" if stamp < since else f"jumps ahead to {stamp:.16g} s"


RATE_HZ = (10.0, 200.0)
_RATE_SLACK = 0.05  # clocks are off by a little, and 10 Hz is the rate of most recordings


class _Limits(NamedTuple):
    """The range of a signal, the size that all but exceptions have, its unit, why a value outside is wrong, and units
    that would bring a too large value back."""

    low: float
    high: float
    plausible: float
    unit: str
    why: str
    suspects: tuple[str, ...] = ()


_SPEED = _Limits(-2.0, 150.0, 70.0, "m/s", "speed is forward speed", ("km/h", "cm/s", "mm/s"))
_ACCEL = _Limits(-50.0, 50.0, 12.0, "m/s2", "no car does that", ("cm/s2", "mm/s2"))
_LIMITS: dict[str, _Limits] = {
    "speed": _SPEED,
    "lead_speed": _SPEED,
    "accel_cmd": _ACCEL,
    "accel": _ACCEL,
    "lead_accel": _ACCEL,
    "jerk": _Limits(-5000.0, 5000.0, 5000.0, "m/s3", "no car does that"),
    "spacing": _Limits(0.0, 10000.0, 300.0, "m", "spacing is bumper to bumper and never negative", ("cm", "mm")),
    "grade": _Limits(-0.5, 0.5, 0.3, "", "grade is rise over run", ("%",)),
    "throttle": _Limits(-1.2, 1.2, 1.0, "", "throttle is a share of the pedal's way", ("%",)),
    "brake": _Limits(-1e6, 1e8, 3e7, "", "brake is a share of the pedal's way, or a pressure in Pa"),
    "torque": _Limits(-1e5, 1e5, 1e4, "Nm", "no car's drive does that"),
    "current": _Limits(-1e4, 1e4, 1000.0, "A", "no car's drive does that", ("mA",)),
    "speed_cmd": _SPEED._replace(low=-20.0, why="speed_cmd is forward speed"),
}


def check_range(
    signal: str, values: FloatArray, where: Callable[[int], str], *, spares: bool = False
) -> dict[int, str]:
    """Raise InputError at the first value (row,) that no car produces; ``where`` names the place of a row, from 0.

    Where it `spares` exceptions, their rows and what is wrong with them: few values, while all others are plausible. A
    speed of 6553.5 among those of a car is a sensor's code; a top speed of 180 that is never left by much is a unit.
    """
    plausible = np.inf
    if signal == "engaged":
        bad, need = ~np.isin(values, (0.0, 1.0)), "0 (driver) or 1 (engaged) is needed"
    elif signal == "segment":
        bad, need, spares = values != np.round(values), "a whole number is needed", False
    elif signal in _LIMITS:
        low, high, plausible, unit, why, suspects = _LIMITS[signal]
        bad = (values < low) | (values > high)
        top = float(np.nanmax(np.abs(values), initial=0.0))
        unit_of = (name for name in suspects if top > high and top * factor(signal, name) <= plausible)
        guess = next(unit_of, None)
        hint = f"; `--unit {signal}={guess}` if that is its unit" if guess else ""
        need = f"{f'{low:g} to {high:g} {unit}'.strip()} is needed ({why}{hint})"
    else:
        return {}
    rows = np.flatnonzero(bad & ~np.isnan(values))
    rest = np.abs(np.delete(values, rows))
    spared = spares and len(rows) <= MOST_BAD * len(values) and np.nanmax(rest, initial=0.0) <= plausible
    faults = {row: f"{where(row)}: is {values[row]:.10g}; {need}" for row in (rows if spared else rows[:1]).tolist()}
    if faults and not spared:
        raise InputError(next(iter(faults.values())))
    return faults


_BEYOND_CLOCKS = 1e24  # nanoseconds since 1970 taken as seconds are 2e18, which `check_rate` reports


def check_rate(step: float, where: str) -> None:
    """Raise InputError for a median ``step`` [s] outside 10 to 200 Hz, naming a probable unit (ms, us, ns)."""
    if not step > 0:
        raise InputError(
            f"{where}: found stamps so far from zero, or from each other, that float64 cannot resolve rows; needs "
            "stamps within 1e9 s of the first"
        )
    rate = 1 / step
    if not RATE_HZ[0] * (1 - _RATE_SLACK) <= rate <= RATE_HZ[1] * (1 + _RATE_SLACK):
        hint = ""
        for unit, ticks in (("ms", 1e3), ("us", 1e6), ("ns", 1e9)):
            if RATE_HZ[0] * (1 - _RATE_SLACK) <= rate * ticks <= RATE_HZ[1] * (1 + _RATE_SLACK):
                hint = f"; `--unit time={unit}` if time counts {unit}"
        raise InputError(
            f"{where}: rows come at {rate:.4g} Hz (median step {step:.4g} s); 10 to 200 Hz is needed{hint}"
        )


# how far two signals of one motion may differ in scale before their units are certainly not the same: recordings exist
# whose acceleration is 1.8 times the derivative of their speed; an actuator that gives 2.5 times the demand does not
SAME_MOTION = (0.45, 2.2)
_COMMAND = (0.02, 2.5)
_SURE = 0.9

SPEED_FACTORS = {"km/h": 3.6, "mph": 3600 / 1609.344, "ft/s": 1 / 0.3048, "cm/s": 100.0, "mm/s": 1000.0}
ACCEL_FACTORS = {"g": GRAVITY, "cm/s2": 0.01, "mm/s2": 0.001, "ft/s2": 0.3048, "km/h/s": 1 / 3.6}


DELAYS_S = tuple(np.arange(0, 1.01, 0.1))


def command_scale(
    time: NDArray, parts: Sequence[slice], speed: NDArray | None, accel: NDArray | None, u: NDArray
) -> Scale | None:
    """How the motion follows the command ``u``: from speed where it is known, else from the integrated acceleration.

    An inverted response counts only where it cannot be a late one (`late_response`).
    """
    level = speed
    if level is None:
        assert accel is not None
        level = integral(time, accel)
    found = scale_between(time, parts, level, u, delays=DELAYS_S)
    if found is not None and found.slope < 0 and found.correlation <= -_SURE:
        later, possible = late_response(time, parts, level, u)
        if possible:
            return later
    return found


def check_units(
    source: str,
    time: NDArray,
    parts: Sequence[slice],
    *,
    accel_cmd: NDArray | None,
    accel: NDArray | None,
    speed: NDArray | None,
    lead_speed: NDArray | None,
) -> None:
    """Raise InputError where two signals prove that one of them has another unit or sign. ``parts``: stretches without
    standstill and without the driver's hand.
    """
    if speed is not None and accel is not None:
        found = scale_between(time, parts, speed, accel)
        options = {f"speed={unit}": factor for unit, factor in SPEED_FACTORS.items()}
        options |= {f"accel={unit}": factor for unit, factor in ACCEL_FACTORS.items()}
        _refuse_scale(source, "speed", "accel", found, SAME_MOTION, options)
    if accel_cmd is not None:
        found = command_scale(time, parts, speed, accel, accel_cmd)
        options = {"accel_cmd=g": GRAVITY, "accel_cmd=cm/s2": 0.01}
        if speed is not None:
            options["speed=km/h"] = 3.6
        answer = "speed" if speed is not None else "accel"
        _refuse_scale(source, answer, "accel_cmd", found, _COMMAND, options)
    if speed is not None and lead_speed is not None:
        ratio = float(np.abs(lead_speed).sum() / max(np.abs(speed).sum(), 1e-9))
        for name, expected in (("lead_speed", 3.6), ("speed", 1 / 3.6)):
            if abs(ratio / expected - 1) < 0.08 and time[-1] - time[0] > 20:
                raise InputError(
                    f"{source}: columns 'lead_speed' and 'speed': the leader is {ratio:.3g} times as fast all along; "
                    f"`--unit {name}=km/h` if that is its unit"
                )


def _refuse_scale(
    source: str, level: str, rate: str, found: Scale | None, limits: tuple[float, float], options: dict[str, float]
) -> None:
    if found is None or abs(found.correlation) < _SURE or limits[0] <= found.slope <= limits[1]:
        return
    place = f"{source}: columns {level!r} and {rate!r}"
    if found.slope < 0:
        raise InputError(
            f"{place}: {level} changes {found.slope:.3g} times as much as {rate} implies, so one has the wrong sign; "
            f"`--unit {rate}=-1` reverses it"
        )
    near = min(options, key=lambda name: abs(math.log(found.slope / options[name])))
    raise InputError(
        f"{place}: {level} changes {found.slope:.3g} times as much as {rate} implies, so their units differ; "
        f"`--unit {near}` is the nearest"
    )
