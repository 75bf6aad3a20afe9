"""Recorded leaders: any of the known forms, told apart by their header."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from avtorch.errors import InputError
from avtorch.io.mapping import Pairs, SignalMap, pairs
from avtorch.io.tables import Table, read_table
from avtorch.io.units import to_si
from avtorch.io.validity import check_range, check_time

Float = NDArray[np.float64]
LONG_STEP_S = 1.5
"""A recording with a longer step between rows is cut there: the drive cycles come at 1 Hz, everything else at 10 Hz."""


@dataclass(frozen=True, eq=False)
class RawLeader:
    """The motion of a recorded vehicle, unsmoothed, at the rate of its file; everything ``(time,)`` and SI.

    ``time`` [s] is the file's own, strictly rising; ``speed`` [m/s] >= 0; ``accel`` [m/s^2] and ``spacing`` [m, to the vehicle
    ahead, bumper to bumper; NaN where not recorded] are None where the file has none. ``events``: what was joined, in
    order. ``note``: what was chosen, cut or mended, in words; empty where nothing was.
    """

    time: Float
    speed: Float
    accel: Float | None
    spacing: Float | None
    name: str
    note: str = ""
    events: tuple[int, ...] = ()


def read_leader(
    path: str | os.PathLike[str],
    *,
    vehicle: int | None = None,
    event: int | None = None,
    duration: float | None = None,
    unit: Pairs = None,
) -> RawLeader:
    """Read a leader from OpenACC (AstaZero or ZalaZONE form), NGSIM events, I-24, or a plain CSV or Parquet of time and speed.

    ``vehicle`` is the file's own number (OpenACC; default: the lowest). ``event`` is the NGSIM event; without it events are
    joined at equal speed until they last ``duration`` [s] (default 80). ``unit`` (``speed=km/h``) holds for the plain form.
    Raises InputError for a file of no known form, a vehicle or event that is not in it, and bad values.
    """
    from avtorch.io import i24, ngsim, openacc

    table = read_table(path, header="Time")
    names = set(table.names)
    form, read = "plain", None
    if "SpeedDoppler1" in names or any(n.startswith("SpeedDoppler") for n in names):
        form, read = "OpenACC", openacc.astazero
    elif "Time" in names and openacc.numbered("Speed", table.names):
        form, read = "OpenACC", lambda t, v: openacc.zalazone(t, v, openacc.vehicle_order(Path(path)))
    elif {"event", "time", "lead_speed"} <= names:
        form = "NGSIM"
    elif {"Time", "Velocity"} <= names:
        form = "I-24"
    _refuse_idle(table.source, form, vehicle=vehicle, event=event, duration=duration, unit=unit)
    if read is not None:
        return read(table, vehicle)
    if form == "NGSIM":
        return ngsim.read_event(table, event) if event is not None else ngsim.join_events(table, duration=duration)
    return i24.read(table) if form == "I-24" else _plain(table, unit)


def _refuse_idle(source: str, form: str, **given: object) -> None:
    takes = {"OpenACC": ("vehicle",), "NGSIM": ("event", "duration"), "I-24": (), "plain": ("unit",)}[form]
    for option, value in given.items():
        if value is not None and option not in takes:
            raise InputError(f"{source}: {option}={value} has no meaning for a leader file of the {form} form")


def _plain(table: Table, unit: Pairs) -> RawLeader:
    speed = next((name for name in ("speed", "lead_speed") if name in table.names), None)
    if "time" not in table.names or speed is None:
        raise InputError(
            f"{table.source}: is no leader file; it needs columns time and speed, or the form of OpenACC, NGSIM or I-24; "
            f"columns: {', '.join(table.names)}"
        )
    units = SignalMap(unit=pairs("unit", unit)).unit
    names = {"time": "time", "speed": speed} | ({"accel": "accel"} if speed == "speed" and "accel" in table.names else {})
    got = {}
    for signal, column in names.items():
        values = table.numbers(column)
        got[signal] = to_si(signal, units[signal])(values) if signal in units else values
    return checked(table, got["time"], got["speed"], got.get("accel"), None, columns=names)


def checked(
    table: Table,
    time: Float,
    speed: Float,
    accel: Float | None,
    spacing: Float | None,
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
    whole = _longest(known, np.diff(time) <= LONG_STEP_S)
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
        spacing = spacing[whole]
        below = spacing < 0
        if below.any():
            spacing = np.where(below, np.nan, spacing)
            notes.append(f"{int(below.sum())} spacings below zero taken as not recorded")
    return RawLeader(time[whole], np.maximum(speed, 0.0), accel, spacing, name or Path(table.source).stem, "; ".join(notes))


def _longest(known: NDArray[np.bool_], near: NDArray[np.bool_]) -> slice | None:
    """The longest run of rows that are known and near to each other, at least two."""
    linked = known[1:] & known[:-1] & near
    edges = np.flatnonzero(np.diff(np.concatenate([[False], linked, [False]]).astype(int)))
    if len(edges) == 0:
        return None
    starts, stops = edges[::2], edges[1::2]
    best = int(np.argmax(stops - starts))
    return slice(int(starts[best]), int(stops[best]) + 1)
