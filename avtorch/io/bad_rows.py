"""Rows of a log that hold a cell nothing can be made of: left out and told, as long as they are few.

A cell that was torn, a sensor's code for "no value", a stamp that jumps: one such cell costs its row. Many in one
column are another matter: then the column is not what it was taken for, and the first of them is the error.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable, Mapping
from itertools import pairwise

import numpy as np

from avtorch.arrays import BoolArray, FloatArray
from avtorch.errors import InputError

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


def beyond(values: FloatArray, low: float, high: float, plausible: float) -> BoolArray:
    """Values (row,) out of a signal's range that are an exception: few, while all others are plausible.

    A speed of 6553.5 among those of a car is a sensor's code; a top speed of 180 that is never left by much is a unit.
    """
    bad = (values < low) | (values > high)
    rest = np.abs(values[~bad & ~np.isnan(values)])
    few = 0 < bad.sum() <= MOST_BAD * len(values)
    return bad if few and len(rest) and rest.max() <= plausible else np.zeros(len(values), bool)


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


def disordered(time: FloatArray, drive: FloatArray, where: Callable[[int], str]) -> dict[int, str]:
    """Faults of the rows of `time` (row,) [s] that do not rise within their drive."""
    faults: dict[int, str] = {}
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


def _course(since: float, stamp: float) -> str:
    if stamp == since:
        return f"repeats {stamp:.16g} s"
    return f"goes back from {since:.16g} s to {stamp:.16g} s" if stamp < since else f"jumps ahead to {stamp:.16g} s"
