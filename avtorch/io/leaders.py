"""Recorded leaders, and followers behind them (OpenACC, NGSIM, I-24, plain tables), recognised by their header."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from avtorch.arrays import BoolArray, FloatArray
from avtorch.errors import InputError, listed
from avtorch.io.log import Log
from avtorch.io.mapping import Pairs
from avtorch.io.tables import Table, read_table
from avtorch.io.validity import check_range, check_time

LONG_STEP_S = 1.5
"""A recording with a longer step between rows is cut there: the drive cycles come at 1 Hz, everything else at 10 Hz."""
NO_LEADER_M = 252.0
"""What I-24's radar writes for a spacing without a leader [m]."""


@dataclass(frozen=True, eq=False)
class RawLeader:
    """The motion of a recorded vehicle, unsmoothed, at the rate of its file.

    ``time`` (time,) [s] is the file's own, strictly rising; ``speed`` (time,) [m/s] >= 0. ``note``: what was selected,
    cut or repaired, in words; empty where nothing was.
    """

    time: FloatArray
    speed: FloatArray
    name: str
    note: str = ""


def read_leader(path: str | os.PathLike[str], *, vehicle: int | None = None, event: int | None = None) -> RawLeader:
    """Read a leader from OpenACC (AstaZero or ZalaZONE form), NGSIM, I-24, or a plain CSV or Parquet of time and speed.

    ``vehicle`` is the file's own number (OpenACC; default: the lowest), ``event`` that of NGSIM (default: the longest).
    A recording is cut to its longest stretch without empty speeds or steps over 1.5 s; ``note`` records the cut.
    Raises InputError for a file of no known form, a vehicle or event that is not in it, an option that does not
    apply, and bad values.
    """
    table = read_table(path, wanted=_RECORDED)
    names = set(table.names)
    options = {"vehicle": vehicle, "event": event}
    stem = Path(table.source).stem
    if platoon := _platoon(names):
        _refuse_idle(table.source, options, "vehicle")
        there = numbered(platoon, names)
        own = there[0] if vehicle is None else vehicle
        if own not in there:
            raise InputError(f"{table.source}: vehicle {own} is not in it; vehicles: {listed(map(str, there))}")
        return _leader(table, "Time", f"{platoon}{own}", name=f"{stem}, vehicle {own}")
    if {"event", "time", "lead_speed"} <= names:
        _refuse_idle(table.source, options, "event")
        number, rows = _event(table, event)
        return _leader(table, "time", "lead_speed", name=f"NGSIM {number}", rows=rows, note=f"event {number}")
    _refuse_idle(table.source, options)
    if {"Time", "Velocity"} <= names:
        return _leader(table, "Time", "Velocity", name=stem)
    speed = next((name for name in ("speed", "lead_speed") if name in names), None)
    if speed is None or "time" not in names:
        raise InputError(
            f"{table.source}: is no leader file; it needs columns time and speed, or the form of OpenACC, NGSIM or "
            f"I-24; columns: {listed(table.names)}"
        )
    return _leader(table, "time", speed, name=stem)


def read_following(
    path: str | os.PathLike[str],
    *,
    vehicle: int | None = None,
    event: int | None = None,
    map: Pairs = None,
    unit: Pairs = None,
    stamp: Pairs = None,
) -> Log:
    """A follower out of OpenACC (AstaZero or ZalaZONE form; ``vehicle``, default: the first that follows one), I-24 or
    NGSIM (``event``, default: the longest), or any log with ``speed``, ``spacing`` and ``lead_speed``.

    Recordings are cut to the longest stretch in which all three are known and the leader stays the same; ``remarks``
    records the cut. ``map``, ``unit``, ``stamp``: of a log, as for ``Log.read``; a recording's form fixes its own.
    Raises InputError for a vehicle or event that is not there or follows nobody, for a spacing that contradicts the
    speeds, for an option that does not apply, and as ``Log.read`` does.

    Example:
        >>> import numpy as np
        >>> from avtorch.io import Log, read_following
        >>> time = np.arange(0.0, 20.0, 0.1)
        >>> columns = dict(speed=20 - np.cos(time), lead_speed=20 + np.sin(time), spacing=np.full(200, 25.0))
        >>> Log.from_arrays(time=time, **columns, following=True).write("following.csv")
        >>> log = read_following("following.csv")
        >>> log.accel_cmd is None, log.rows
        (True, 200)
    """
    table = read_table(path, wanted=_RECORDED)
    names = set(table.names)
    options = {"vehicle": vehicle, "event": event, "map": map or None, "unit": unit or None, "stamp": stamp or None}
    stem = Path(table.source).stem
    if platoon := _platoon(names):
        _refuse_idle(table.source, options, "vehicle")
        own = _follower(table, platoon, vehicle)
        three = (f"{platoon}{own}", _spacing(platoon, own), f"{platoon}{own - 1}")
        speed, spacing, lead = (table.numbers(column, empty_is_nan=True) for column in three)
        return _whole(f"{stem}, vehicle {own}", table.numbers("Time"), speed, spacing, lead)
    if {"Time", "Velocity", "SpaceGap", "RelativeVelocity"} <= names:
        _refuse_idle(table.source, options)
        three = ("Velocity", "SpaceGap", "RelativeVelocity")
        speed, gap, faster = (table.numbers(column, empty_is_nan=True) for column in three)
        gap = np.where(gap >= NO_LEADER_M, np.nan, gap)
        return _whole(stem, table.numbers("Time"), speed / 3.6, gap, speed / 3.6 + faster)
    if {"event", "time", "spacing", "speed", "lead_speed"} <= names:
        _refuse_idle(table.source, options, "event")
        number, rows = _event(table, event)
        time, speed, spacing, lead = (table.numbers(n)[rows] for n in ("time", "speed", "spacing", "lead_speed"))
        return _whole(f"NGSIM {number}", time, speed, spacing, lead)
    _refuse_idle(table.source, options, "map", "unit", "stamp")
    return Log.read(path, map=map, unit=unit, stamp=stamp, following=True)


_RECORDED = re.compile(
    r"(SpeedDoppler|Spacing|Speed|IVS)[0-9]{1,6}"  # OpenACC, by vehicle
    r"|Time|Velocity|SpaceGap|RelativeVelocity"  # I-24
    r"|event|time|speed|spacing|lead_speed"  # NGSIM, and plain ones
)


def _refuse_idle(source: str, options: Mapping[str, object], *takes: str) -> None:
    for option, value in options.items():
        if value is not None and option not in takes:
            argument = f"{option} {value}" if isinstance(value, (int, float)) else option
            raise InputError(f"{source}: {argument} has no meaning for a file of this form")


def numbered(stem: str, names: Iterable[str]) -> list[int]:
    """The vehicle numbers of the columns ``stem`` + number, rising; numbers can skip."""
    found = (re.fullmatch(rf"{stem}([0-9]{{1,6}})", name) for name in names)
    return sorted(int(match[1]) for match in found if match)


def _platoon(names: Iterable[str]) -> str:
    """What a vehicle's speed is called before its number in a file of OpenACC; empty in any other.

    The AstaZero form is ``Time, X_i, SpeedDoppler_i, Accel_i, Spacing_i`` (to the vehicle ahead), the ZalaZONE one,
    after its header lines, ``Time, Speed_i, E_i, N_i, Alt_i, IVS_i``: the spacing between vehicles i and i + 1.
    """
    names = set(names)
    return next((stem for stem in ("SpeedDoppler", "Speed") if "Time" in names and numbered(stem, names)), "")


def _spacing(platoon: str, number: int) -> str:
    return f"Spacing{number}" if platoon == "SpeedDoppler" else f"IVS{number - 1}"


def _follower(table: Table, platoon: str, vehicle: int | None) -> int:
    numbers = numbered(platoon, table.names)
    followers = [n for n in numbers if n - 1 in numbers and _spacing(platoon, n) in table.names]
    if not followers:
        raise InputError(f"{table.source}: no vehicle has a spacing to one ahead whose speed is there")
    own = followers[0] if vehicle is None else vehicle
    if own not in followers:
        known = listed(map(str, followers))
        raise InputError(f"{table.source}: vehicle {own} follows nobody in it; followers: {known}")
    return own


def _leader(
    table: Table, clock: str, column: str, *, name: str, rows: slice = slice(None), note: str = ""
) -> RawLeader:
    """The leader of some rows of two columns, checked, cut to the longest stretch that is whole.

    Empty cells of a recording and long steps end a stretch.
    """
    scale = 3.6 if column == "Velocity" else 1.0
    time = table.numbers(clock)[rows]
    speed = table.numbers(column, empty_is_nan=clock == "Time")[rows] / scale
    if len(time) < 2:
        raise InputError(f"{table.source}: {name} has {len(time)} rows of data; a leader needs at least two")
    first = rows.start or 0
    check_time(time, lambda row: table.where(first + row, clock))
    known = ~np.isnan(speed)
    check_range("speed", np.where(known, speed, 0.0), lambda row: table.where(first + row, column))
    whole = _longest(known[1:] & known[:-1] & (np.diff(time) <= LONG_STEP_S))
    if whole is None:
        raise InputError(f"{table.source}: column {column!r}: no two rows in a row hold a speed")
    notes = [note] if note else []
    if whole.stop - whole.start < len(time):
        notes.append(f"the longest whole stretch, rows {whole.start + 1} to {whole.stop} of {len(time)}")
    speed = speed[whole]
    if (speed < 0).any():
        notes.append(f"{int((speed < 0).sum())} speeds a little below zero set to zero")
    return RawLeader(time[whole], np.maximum(speed, 0.0), name, "; ".join(notes))


def _longest(linked: BoolArray) -> slice | None:
    """The longest run of rows each ``linked`` to the next, at least two."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], linked, [False]]).astype(int)))
    if len(edges) == 0:
        return None
    starts, stops = edges[::2], edges[1::2]
    best = int(np.argmax(stops - starts))
    return slice(int(starts[best]), int(stops[best]) + 1)


def _event(table: Table, event: int | None) -> tuple[int, slice]:
    """The number of an NGSIM event and its rows; None: the longest one, of several the first by number."""
    numbers = table.numbers("event")
    if not len(numbers):
        raise InputError(f"{table.source}: found a header but no rows; needs a recording")
    bad = np.flatnonzero(numbers != np.round(numbers))
    if len(bad):
        where = table.where(int(bad[0]), "event")
        raise InputError(f"{where}: is {numbers[bad[0]]:g}; a whole number is needed")
    events: dict[int, slice] = {}
    edges = [0, *(np.flatnonzero(np.diff(numbers)) + 1).tolist(), len(numbers)]
    for first, last in pairwise(edges):
        number = int(numbers[first])
        if number in events:
            where = table.where(first, "event")
            raise InputError(f"{where}: event {number} goes on after another; keep its rows together")
        events[number] = slice(first, last)
    if event is None:
        event = max(sorted(events), key=lambda one: events[one].stop - events[one].start)
    if event not in events:
        raise InputError(f"{table.source}: event {event} is not in it; events {min(events)} to {max(events)} are")
    return event, events[event]


_FOLLOWING_STEP_S = 0.25
_DRIFT_M, _DRIFT_MPS = 5.0, 0.15  # allowed difference of spacing and integrated speeds over a stretch
_JUMP_M = 2.0  # a larger jump of the gap from row to row, beyond what both speeds imply, means another leader


def _whole(name: str, time: FloatArray, speed: FloatArray, spacing: FloatArray, lead: FloatArray) -> Log:
    """The longest stretch in which everything is known, as a log."""
    known = np.isfinite(speed) & np.isfinite(lead) & np.isfinite(spacing) & (np.nan_to_num(spacing) > 0)
    steps = np.diff(time)
    linked = known[1:] & known[:-1] & (steps <= _FOLLOWING_STEP_S) & (steps > 0)
    with np.errstate(invalid="ignore"):
        linked &= ~(np.abs(np.diff(spacing) - steps * (lead - speed)[:-1]) > _JUMP_M)
    part = _longest(linked)
    if part is None:
        raise InputError(f"{name}: no two rows in a row hold speed, spacing and the leader's speed")
    opened = float(spacing[part][-1] - spacing[part][0])
    implied = float(np.sum(np.diff(time[part]) * (lead - speed)[part][:-1]))
    if abs(opened - implied) > _DRIFT_M + _DRIFT_MPS * float(time[part][-1] - time[part][0]):
        raise InputError(
            f"{name}: the spacing grew by {opened:.0f} m where the speeds imply {implied:.0f} m; "
            "needs spacing and speeds of one and the same leader"
        )
    log = Log.from_arrays(
        name=name,
        time=time[part],
        speed=np.maximum(speed[part], 0.0),
        spacing=spacing[part],
        lead_speed=np.maximum(lead[part], 0.0),
        following=True,
    )
    if part.stop - part.start == len(time):
        return log
    remark = (
        f"the longest stretch behind one leader with all known, rows {part.start + 1} to {part.stop} of {len(time)}"
    )
    return replace(log, remarks=(remark,))
