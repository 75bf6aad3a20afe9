"""Recorded leaders, and followers behind them (OpenACC, NGSIM, I-24, plain tables), recognised by their header."""

from __future__ import annotations

import csv
import io
import os
import re
from collections.abc import Iterable
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from avtorch.arrays import BoolArray, FloatArray
from avtorch.errors import InputError, listed, printable
from avtorch.io.log import Log
from avtorch.io.mapping import Pairs, pairs
from avtorch.io.opening import place
from avtorch.io.tables import Table, read_bytes, read_table
from avtorch.io.text import decoded
from avtorch.io.units import to_si
from avtorch.io.validity import check_range, check_time, scale_between

LONG_STEP_S = 1.5
"""A recording with a longer step between rows is cut there: the drive cycles come at 1 Hz, everything else at 10 Hz."""


@dataclass(frozen=True, eq=False)
class RawLeader:
    """The motion of a recorded vehicle, unsmoothed, at the rate of its file; everything ``(time,)`` and SI.

    ``time`` [s] is the file's own, strictly rising; ``speed`` [m/s] >= 0; ``accel`` [m/s^2] and ``spacing`` [m, to the
    vehicle ahead, bumper to bumper; NaN where not recorded] are None where the file has none. ``events``: the joined
    events, in order. ``note``: what was selected, cut or repaired, in words; empty where nothing was.
    """

    time: FloatArray
    speed: FloatArray
    accel: FloatArray | None
    spacing: FloatArray | None
    name: str
    note: str = ""
    events: tuple[int, ...] = ()


def checked_leader(
    table: Table,
    time: FloatArray,
    speed: FloatArray,
    accel: FloatArray | None,
    spacing: FloatArray | None,
    *,
    columns: dict[str, str],
    name: str = "",
    note: str = "",
) -> RawLeader:
    """A leader out of the columns of ``table``, values checked, cut to the longest stretch that is whole.

    NaN in ``speed`` (empty cells) and long steps end a stretch. ``columns``: signal to column, for the messages.
    """
    notes = [note] if note else []
    if table.rows < 2:
        raise InputError(f"{table.source}: has {table.rows} rows of data; a leader needs at least two")
    check_time(time, np.ones(len(time) - 1, bool), lambda row: table.where(row, columns["time"]))
    known = ~np.isnan(speed)
    for signal, values in (("speed", speed), ("accel", accel)):
        if values is not None:
            filled = np.where(np.isnan(values), 0.0, values)
            check_range(signal, filled, lambda row, c=columns[signal]: table.where(row, c))
    whole = _longest(known[1:] & known[:-1] & (np.diff(time) <= LONG_STEP_S))
    if whole is None:
        raise InputError(f"{table.source}: column {columns['speed']!r}: no two rows in a row hold a speed")
    if whole.stop - whole.start < len(time):
        notes.append(f"the longest whole stretch, rows {whole.start + 1} to {whole.stop} of {len(time)}")
    speed = speed[whole]
    if (speed < 0).any():
        notes.append(f"{int((speed < 0).sum())} speeds a little below zero set to zero")
    if accel is not None:
        accel = accel[whole]
        if np.isnan(accel).any():
            accel = None
            notes.append("acceleration left out: some of it is empty")
    if spacing is not None:
        below = spacing[whole] < 0
        spacing = np.where(below, np.nan, spacing[whole])
        if below.any():
            notes.append(f"{int(below.sum())} spacings below zero taken as not recorded")
    name = name or Path(table.source).stem
    return RawLeader(time[whole], np.maximum(speed, 0.0), accel, spacing, name, "; ".join(notes))


def _longest(linked: BoolArray) -> slice | None:
    """The longest run of rows each ``linked`` to the next, at least two."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], linked, [False]]).astype(int)))
    if len(edges) == 0:
        return None
    starts, stops = edges[::2], edges[1::2]
    best = int(np.argmax(stops - starts))
    return slice(int(starts[best]), int(stops[best]) + 1)


NO_LEADER_M = 252.0


def _i24(table: Table) -> RawLeader:
    """The instrumented car itself, as a leader for others.

    Its ``Acceleration`` is passed on as recorded; where its scale differs from the derivative of the speed, the note
    gives the ratio.
    """
    columns = {"time": "Time", "speed": "Velocity"}
    time, speed = table.numbers("Time"), table.numbers("Velocity", empty_is_nan=True) / 3.6
    accel = spacing = None
    note = ""
    if "Acceleration" in table.names:
        columns["accel"] = "Acceleration"
        accel = table.numbers("Acceleration", empty_is_nan=True)
        whole = ~np.isnan(speed) & ~np.isnan(accel)
        found = scale_between(time, [slice(None)], speed, accel) if whole.all() else None
        if found is not None and found.correlation > 0.9 and not 0.8 < found.slope < 1.25:
            note = f"recorded acceleration is {1 / found.slope:.2f} times the derivative of the speed"
    if "SpaceGap" in table.names:
        gap = table.numbers("SpaceGap", empty_is_nan=True)
        spacing = np.where(gap >= NO_LEADER_M, np.nan, gap)
    return checked_leader(table, time, speed, accel, spacing, columns=columns, note=note)


def numbered(stem: str, names: Iterable[str]) -> list[int]:
    """The vehicle numbers of the columns ``stem`` + number, rising; numbers can skip."""
    found = (re.fullmatch(rf"{stem}([0-9]{{1,6}})", name) for name in names)
    return sorted(int(match[1]) for match in found if match)


def _stem(names: Iterable[str]) -> str:
    """What a vehicle's speed is called before its number in a file of OpenACC; empty in any other.

    The AstaZero form is ``Time, X_i, SpeedDoppler_i, Accel_i, Spacing_i`` (to the vehicle ahead), the ZalaZONE one,
    after its header lines, ``Time, Speed_i, E_i, N_i, Alt_i, IVS_i``: the spacing between vehicles i and i + 1.
    """
    names = set(names)
    if any(name.startswith("SpeedDoppler") for name in names):
        return "SpeedDoppler"
    return "Speed" if "Time" in names and numbered("Speed", names) else ""


def _spacing(stem: str, number: int) -> str:
    return f"Spacing{number}" if stem == "SpeedDoppler" else f"IVS{number - 1}"


def _vehicle(table: Table, number: int, order: tuple[str, ...]) -> str:
    make = f" ({order[number - 1]})" if 0 < number <= len(order) else ""
    return f"{Path(table.source).stem}, vehicle {number}{make}"


def openacc(table: Table, vehicle: int | None = None, order: tuple[str, ...] = ()) -> RawLeader:
    """A vehicle of OpenACC; numbers can skip and cells can be empty. ``order``: the makes, by number."""
    stem = _stem(table.names)
    number = _choose(table, stem, vehicle)
    columns = {"time": "Time", "speed": f"{stem}{number}"}
    if stem == "SpeedDoppler" and f"Accel{number}" in table.names:
        columns["accel"] = f"Accel{number}"
    time, speed = table.numbers("Time"), table.numbers(columns["speed"], empty_is_nan=True)
    accel = table.numbers(columns["accel"], empty_is_nan=True) if "accel" in columns else None
    ahead = _spacing(stem, number)
    spacing = table.numbers(ahead, empty_is_nan=True) if ahead in table.names else None
    return checked_leader(table, time, speed, accel, spacing, columns=columns, name=_vehicle(table, number, order))


def vehicle_order(path: Path) -> tuple[str, ...]:
    """The makes that the header lines of a ZalaZONE file list, first the leader; empty where they list none."""
    for line in islice(io.StringIO(decoded(place(path), read_bytes(path))[0], newline=""), 10):
        try:
            row = next(csv.reader([line]), [])
        except csv.Error:  # no line of makes
            continue
        if row and row[0] == "Vehicle_order":
            return tuple(printable(cell, 40) for cell in row[1:] if cell)
    return ()


def _choose(table: Table, stem: str, vehicle: int | None) -> int:
    there = numbered(stem, table.names)
    if not there:
        raise InputError(f"{table.source}: found no column {stem}1, {stem}2, ...; needs one for each vehicle")
    if vehicle is None:
        return there[0]
    if vehicle not in there:
        raise InputError(f"{table.source}: vehicle {vehicle} is not in it; vehicles: {listed(map(str, there))}")
    return vehicle


DURATION_S = 80.0
JOIN_SPEED_MPS = 0.2
JOIN_WITHIN_S = 5.0
_LOOK_S = 0.5  # the acceleration on either side of a joint is taken over this long


def read_event(table: Table, event: int) -> RawLeader:
    """The leader of one event; its time starts at 0. InputError where the file has no such event."""
    table = _parsed(table)
    return _event(table, _numbers(table), event)


def join_events(table: Table, *, duration: float | None = None, first: int | None = None) -> RawLeader:
    """A leader of at least ``duration`` [s] (default 80) out of events joined at equal speed.

    Rule. Start with the longest event, or ``first``. At its end, search the first 5 s of every event not yet used
    (each leaves at least 10 s to drive) for samples whose lead speed is within 0.2 m/s of the last one; take the sample
    whose acceleration over the next 0.5 s is nearest to that of the last 0.5 s, ties to the lower event number, and go
    on from the sample after it, speeds as recorded. ``events`` and ``note`` of the result list what was joined. Raises
    InputError where no event fits before ``duration`` is reached.
    """
    wanted = DURATION_S if duration is None else float(duration)
    if not 0 < wanted < np.inf:
        raise InputError(f"duration: is {duration}; a positive number of seconds is needed")
    table = _parsed(table)
    numbers = _numbers(table)
    ids, counts = np.unique(numbers, return_counts=True)
    start = int(ids[np.argmax(counts)]) if first is None else first
    leaders = {int(i): _event(table, numbers, int(i)) for i in ids}
    if start not in leaders:
        raise InputError(f"{table.source}: event {start} is not in it; events {ids[0]:.0f} to {ids[-1]:.0f} are")
    time, speed = leaders[start].time, leaders[start].speed
    used, joints = [start], []
    while time[-1] < wanted - 1e-9:
        fit = _best_fit(time, speed, {i: x for i, x in leaders.items() if i not in used})
        if fit is None:
            raise InputError(
                f"{table.source}: after {time[-1]:.1f} s (events {used}) no further event starts within "
                f"{JOIN_SPEED_MPS} m/s of {speed[-1]:.2f} m/s; ask for a shorter duration than {wanted:g} s"
            )
        event, sample = fit
        other = leaders[event]
        joints.append(f"at {time[-1]:.1f} s")
        time = np.concatenate([time, time[-1] + other.time[sample + 1 :] - other.time[sample]])
        speed = np.concatenate([speed, other.speed[sample + 1 :]])
        used.append(event)
    listing = ", ".join(map(str, used))
    note = f"events {listing} joined at equal speed ({', '.join(joints)})" if joints else f"event {listing}"
    return RawLeader(time, speed, None, None, f"NGSIM {'+'.join(map(str, used))}", note, tuple(used))


def _best_fit(time: NDArray, speed: NDArray, others: dict[int, RawLeader]) -> tuple[int, int] | None:
    before = _slope(time, speed, time[-1] - _LOOK_S, time[-1])
    best: tuple[float, int, int] | None = None
    for event, other in others.items():
        early = other.time <= min(JOIN_WITHIN_S, other.time[-1] - 10)
        for sample in np.flatnonzero(early & (np.abs(other.speed - speed[-1]) <= JOIN_SPEED_MPS)):
            at = other.time[sample]
            kink = abs(_slope(other.time, other.speed, at, at + _LOOK_S) - before)
            if best is None or (kink, event, int(sample)) < best:
                best = (kink, event, int(sample))
    return None if best is None else best[1:]


def _slope(time: NDArray, speed: NDArray, start: float, end: float) -> float:
    a, b = np.interp([start, end], time, speed)
    return float(b - a) / (end - start)


def _parsed(table: Table) -> Table:
    """The three columns needed, read once for all events."""
    names = ("event", "time", "lead_speed")
    return Table(table.source, names, tuple(table.numbers(name) for name in names), table.lines)


def _numbers(table: Table) -> FloatArray:
    numbers = table.numbers("event")
    bad = numbers != np.round(numbers)
    if bad.any():
        row = int(np.argmax(bad))
        raise InputError(f"{table.where(row, 'event')}: is {numbers[row]:g}; a whole number is needed")
    return numbers


def _event(table: Table, numbers: NDArray, event: int) -> RawLeader:
    rows = np.flatnonzero(numbers == event)
    if len(rows) == 0:
        raise InputError(
            f"{table.source}: event {event} is not in it; events {numbers.min():.0f} to {numbers.max():.0f} are"
        )
    if rows[-1] - rows[0] + 1 != len(rows):
        cut = rows[int(np.argmax(np.diff(rows) > 1)) + 1]
        raise InputError(
            f"{table.where(int(cut), 'event')}: event {event} goes on after another; keep its rows together"
        )
    part = slice(int(rows[0]), int(rows[-1]) + 1)
    lines = None if table.lines is None else table.lines[part]
    piece = Table(
        table.source,
        table.names,
        tuple(None if cells is None else cells[part] for cells in table.cells),
        lines,
        first=part.start,
    )
    leader = checked_leader(
        piece,
        piece.numbers("time"),
        piece.numbers("lead_speed"),
        None,
        None,
        columns={"time": "time", "speed": "lead_speed"},
        name=f"NGSIM {event}",
    )
    note = "; ".join(x for x in (f"event {event}", leader.note) if x)
    return RawLeader(leader.time, leader.speed, None, None, leader.name, note, (event,))


def read_leader(
    path: str | os.PathLike[str],
    *,
    vehicle: int | None = None,
    event: int | None = None,
    duration: float | None = None,
    unit: Pairs = None,
) -> RawLeader:
    """Read a leader from OpenACC (AstaZero or ZalaZONE form), NGSIM, I-24, or a plain CSV or Parquet of time and speed.

    ``vehicle`` is the file's own number (OpenACC; default: the lowest). ``event`` is the NGSIM event; without it events
    are joined at equal speed until they last ``duration`` [s] (default 80). ``unit`` (``speed=km/h``) is for the plain
    form. A recording is cut to its longest stretch without empty speeds or steps over 1.5 s; ``note`` records the cut.
    Raises InputError for a file of no known form, a vehicle or event that is not in it, and bad values.
    """
    table = read_table(path, header="Time", wanted=recorded)
    names = set(table.names)
    if stem := _stem(names):
        form = "OpenACC"
    elif {"event", "time", "lead_speed"} <= names:
        form = "NGSIM"
    elif {"Time", "Velocity"} <= names:
        form = "I-24"
    elif {"speed", "lead_speed"} & names and "time" in names:
        form = "plain"
    else:
        raise InputError(
            f"{table.source}: is no leader file; it needs columns time and speed, or the form of OpenACC, NGSIM or "
            f"I-24; columns: {listed(table.names)}"
        )
    _refuse_idle(table.source, form, vehicle=vehicle, event=event, duration=duration, unit=unit)
    if not table.rows:
        raise InputError(f"{table.source}: found a header but no rows; needs a recording")
    if stem:
        return openacc(table, vehicle, vehicle_order(Path(path)) if stem == "Speed" else ())
    if form == "NGSIM":
        return read_event(table, event) if event is not None else join_events(table, duration=duration)
    return _i24(table) if form == "I-24" else _plain(table, unit)


def _refuse_idle(source: str, form: str, **given: object) -> None:
    takes = {"OpenACC": ("vehicle",), "NGSIM": ("event", "duration"), "I-24": (), "plain": ("unit",)}[form]
    for option, value in given.items():
        if value is not None and option not in takes:
            raise InputError(f"{source}: {option}={value} has no meaning for a leader file of the {form} form")


def _plain(table: Table, unit: Pairs) -> RawLeader:
    speed = next(name for name in ("speed", "lead_speed") if name in table.names)
    units = pairs("unit", unit)
    names = {"time": "time", "speed": speed}
    if speed == "speed" and "accel" in table.names:
        names["accel"] = "accel"
    got = {}
    for signal, column in names.items():
        values = table.numbers(column)
        got[signal] = to_si(signal, units[signal])(values) if signal in units else values
    return checked_leader(table, got["time"], got["speed"], got.get("accel"), None, columns=names)


_PLAIN = frozenset(
    (
        "Time", "Velocity", "Acceleration", "SpaceGap", "RelativeVelocity",  # I-24
        "event", "time", "speed", "accel", "spacing", "lead_speed",  # NGSIM, and plain ones
    )
)  # fmt: skip
_NUMBERED = re.compile(r"(SpeedDoppler|Accel|Spacing|Speed|IVS)[0-9]{1,6}")  # OpenACC, by vehicle


def recorded(names: Iterable[str]) -> set[str]:
    """Those of a file's columns that a known form has."""
    return {name for name in names if name in _PLAIN or _NUMBERED.fullmatch(name)}


_FOLLOWING_STEP_S = 0.25
_DRIFT_M, _DRIFT_MPS = 5.0, 0.15  # allowed difference of spacing and integrated speeds over a stretch
_JUMP_M = 2.0  # a larger jump of the gap from row to row, beyond what both speeds imply, means another leader


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
    table = read_table(path, header="Time", wanted=recorded)
    names = set(table.names)
    columns: dict[str, object] = {"map": map or None, "unit": unit or None, "stamp": stamp or None}
    if stem := _stem(names):
        _idle(table.source, event=event, **columns)
        numbers = numbered(stem, names)
        own = _follower(table.source, vehicle, [n for n in numbers if n - 1 in numbers and _spacing(stem, n) in names])
        three = (table.numbers(c, empty_is_nan=True) for c in (f"{stem}{own}", _spacing(stem, own), f"{stem}{own - 1}"))
        makes = vehicle_order(Path(path)) if stem == "Speed" else ()
        return _whole(_vehicle(table, own, makes), table.numbers("Time"), *three)
    if {"Time", "Velocity", "SpaceGap", "RelativeVelocity"} <= names:
        _idle(table.source, vehicle=vehicle, event=event, **columns)
        return _instrumented(table)
    if {"event", "time", "spacing", "speed", "lead_speed"} <= names:
        _idle(table.source, vehicle=vehicle, **columns)
        return _following_event(table, event)
    _idle(table.source, vehicle=vehicle, event=event)
    return Log.read(path, map=map, unit=unit, stamp=stamp, following=True)


def _idle(source: str, **given: object) -> None:
    for option, value in given.items():
        if value is not None:
            argument = f"{option} {value}" if isinstance(value, int) else option
            raise InputError(f"{source}: {argument} has no meaning for a file of this form")


def _follower(source: str, vehicle: int | None, followers: list[int]) -> int:
    if not followers:
        raise InputError(f"{source}: no vehicle has a spacing to one ahead whose speed is there")
    if vehicle is None:
        return followers[0]
    if vehicle not in followers:
        known = listed(map(str, followers))
        raise InputError(f"{source}: vehicle {vehicle} follows nobody in it; followers: {known}")
    return vehicle


def _instrumented(table: Table) -> Log:
    speed = table.numbers("Velocity", empty_is_nan=True) / 3.6
    gap = table.numbers("SpaceGap", empty_is_nan=True)
    lead = speed + table.numbers("RelativeVelocity", empty_is_nan=True)
    gap = np.where(gap >= NO_LEADER_M, np.nan, gap)
    return _whole(Path(table.source).stem, table.numbers("Time"), speed, gap, lead)


def _following_event(table: Table, event: int | None) -> Log:
    numbers = table.numbers("event")
    ids, counts = np.unique(numbers, return_counts=True)
    own = int(ids[np.argmax(counts)]) if event is None else event
    rows = numbers == own
    if not rows.any():
        raise InputError(f"{table.source}: event {own} is not in it; events {ids[0]:.0f} to {ids[-1]:.0f} are")
    time, speed, spacing, lead = (table.numbers(n)[rows] for n in ("time", "speed", "spacing", "lead_speed"))
    return _whole(f"NGSIM {own}", time, speed, spacing, lead)


def _whole(name: str, time: FloatArray, speed: FloatArray, spacing: FloatArray, lead: FloatArray) -> Log:
    """The longest stretch in which everything is known, as a log."""
    known = np.isfinite(speed) & np.isfinite(lead) & np.isfinite(spacing) & (np.nan_to_num(spacing) > 0)
    steps = np.diff(time)
    linked = known[1:] & known[:-1] & (steps <= _FOLLOWING_STEP_S) & (steps > 0)
    with np.errstate(invalid="ignore"):
        jumped = np.abs(np.diff(spacing) - steps * (lead - speed)[:-1]) > _JUMP_M
    linked &= ~jumped
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
