"""Time from the log's start, used by every computation, so that the origin of the clock does not change any answer.

A float64 near 1.7e9, the seconds since 1970, comes in steps of 2.4e-7 s: differences of such stamps are off by as much,
and a clock of exactly 100 Hz shows steps of 0.0099999 and 0.0100002 s. Stamps this coarse still hold the decimals that
the recorder wrote. So a difference from the first stamp is rounded to the decimals that the stamps resolve, which gives
a recorder's microseconds back exactly, and rows that are even up to that rounding are made even.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from itertools import pairwise
from typing import Any

import numpy as np

from avtorch.arrays import BoolArray, FloatArray, IntArray

UNIX_S = (946_684_800.0, 4_102_444_800.0)
"""Stamps in here may count seconds since 1970: the years 2000 to 2099."""
ROUNDING_S = 1e-5
"""Larger than the rounding error of a difference of stamps [s], and smaller than any step between rows."""
_FINEST = 12
_ANOTHER_CLOCK_S = 1e6  # between two segments, some twelve days: the clock was set, not the car parked
_SET_ANEW_S = 1.0
_EVEN = 1e-9  # of a step: negligible


def decimals(largest: float) -> int:
    """Decimals [of a second] that the difference of two stamps of up to `largest` [s] still resolves.

    Each stamp is rounded by half a step of float64, so the difference is off by up to a whole one: the nearest decimal
    is the recorder's own where half a unit of it is more than that.
    """
    return min(_FINEST, math.floor(-math.log10(2.0 * float(np.spacing(max(abs(largest), 1.0))))))


def since(stamps: FloatArray, origin: float, *, largest: float | None = None) -> FloatArray:
    """`stamps` (row,) [s] as seconds from `origin`, free of the rounding of stamps of that size.

    `largest`: size of the largest stamp where several arrays are to be rounded alike. Stamps closer together than these
    decimals resolve are not rounded.
    """
    away = stamps - origin
    if not len(stamps):
        return away
    size = max(float(np.abs(stamps).max()), abs(origin)) if largest is None else largest
    rounded = np.round(away, decimals(size))
    return away if bool(((np.diff(rounded) <= 0) & (np.diff(away) > 0)).any()) else rounded


def since_start(stamps: FloatArray, segment: IntArray) -> FloatArray:
    """Seconds (row,) from the first row of a log; `segment` (row,) numbers its drives, within each of which rows that
    are even up to the stamps' resolution become even.

    A segment that starts more than `_ANOTHER_CLOCK_S` away has another clock: it is placed a second after the one
    before.
    """
    out = np.empty(len(stamps))
    cuts = [0, *(np.flatnonzero(np.diff(segment)) + 1).tolist(), len(stamps)]
    origin, ahead = (float(stamps[0]) if len(stamps) else 0.0), 0.0
    for first, last in pairwise(cuts):
        part = stamps[first:last]
        if first == last:
            continue
        if first and abs(part[0] - stamps[first - 1]) > _ANOTHER_CLOCK_S:
            origin, ahead = float(part[0]), float(out[first - 1]) + _SET_ANEW_S
        size = max(float(np.abs(part).max()), abs(origin))
        seconds = since(part, origin, largest=size)
        out[first:last] = _even(seconds, 10.0 ** -decimals(size)) + ahead
    return out


def _even(time: FloatArray, finest: float) -> FloatArray:
    """`time` (row,) on an even grid, with lost rows allowed, where it deviates from the grid only by its own
    rounding."""
    steps = np.diff(time)
    usual = float(np.median(steps)) if len(steps) else 0.0
    # rows further apart than float64 counts steps lie on no grid
    if usual <= 0 or time[-1] - time[0] > usual * 2**52:
        return time
    number = np.concatenate([[0.0], np.cumsum(np.rint(steps / usual))])
    step = (time[-1] - time[0]) / max(number[-1], 1.0)
    even = time[0] + number * step
    off = float(np.abs(even - time).max())
    return even if _EVEN * usual < off <= finest else time


def clock_words(stamp: float) -> str:
    """A stamp [s] for messages: the number, and its date if it counts from 1970."""
    number = f"{round(stamp, decimals(stamp)):.15g} s"
    if not UNIX_S[0] <= stamp < UNIX_S[1]:
        return number
    date = datetime.fromtimestamp(math.floor(stamp), UTC)
    return f"{number}, as Unix time {date:%Y-%m-%d %H:%M:%S} UTC"


def from_start(entries: Sequence[Mapping[str, Any]], epoch_s: float) -> list[dict[str, Any]]:
    """Windows or alerts of an answer, their `start_s`, `end_s` and `time_s` counted from a log's start at `epoch_s`."""
    keys = ("start_s", "end_s", "time_s")
    return [{**x, **{key: round(x[key] - epoch_s, decimals(epoch_s)) for key in keys if key in x}} for x in entries]


def time_label(epoch_s: float) -> str:
    """Of the time axis of a picture."""
    return "time [s]" if epoch_s == 0 else f"time [s] from the log's start at {clock_words(epoch_s)}"


GAP_STEPS = 3.0
GAP_SECONDS = 0.1
"""A step longer than both GAP_STEPS median steps and GAP_SECONDS is a gap: what is shorter is jitter or a lost row."""


def stretches(mask: BoolArray, segment: IntArray) -> list[slice]:
    """Unbroken runs of rows, within one segment each, where ``mask`` holds."""
    key = np.where(mask, segment, -1)
    cuts = np.flatnonzero(np.diff(key)) + 1
    edges = [0, *cuts.tolist(), len(key)]
    return [slice(a, b) for a, b in pairwise(edges) if mask[a]]


def median_step(time: FloatArray, same_drive: BoolArray) -> float:
    """Median time between rows [s], steps across drives left out."""
    steps = np.diff(time)
    return float(np.median(steps[same_drive] if same_drive.any() else np.abs(steps)))


def gap_limit(step: float) -> float:
    """The longest time between two rows [s] that is not a gap, at a median ``step`` [s].

    A little more than the bound: two rows lost at 30 Hz make 0.1 s, give or take the rounding of the stamps.
    """
    return max(GAP_STEPS * step, GAP_SECONDS) + ROUNDING_S
