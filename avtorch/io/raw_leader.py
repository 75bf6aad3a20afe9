"""The common type of all forms of leader files, and their shared checks."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from avtorch.arrays import BoolArray, FloatArray
from avtorch.errors import InputError
from avtorch.io.tables import Table
from avtorch.io.validity import check_range, check_time

LONG_STEP_S = 1.5
"""A recording with a longer step between rows is cut there: the drive cycles come at 1 Hz, everything else at 10 Hz."""


@dataclass(frozen=True, eq=False)
class RawLeader:
    """The motion of a recorded vehicle, unsmoothed, at the rate of its file; everything ``(time,)`` and SI.

    ``time`` [s] is the file's own, strictly rising; ``speed`` [m/s] >= 0; ``accel`` [m/s^2] and ``spacing`` [m, to the
    vehicle ahead, bumper to bumper; NaN where not recorded] are None where the file has none. ``events``: the joined
    events, in order. ``note``: what was selected, cut or repaired, in words; empty where nothing was.

    Example:
        >>> import numpy as np
        >>> from avtorch.io import RawLeader
        >>> time = np.arange(0.0, 5.0, 0.1)
        >>> leader = RawLeader(time, speed=20 - time, accel=None, spacing=None, name="braking")
        >>> leader.name, leader.speed.shape
        ('braking', (50,))
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
        below = spacing[whole] < 0
        spacing = np.where(below, np.nan, spacing[whole])
        if below.any():
            notes.append(f"{int(below.sum())} spacings below zero taken as not recorded")
    name = name or Path(table.source).stem
    return RawLeader(time[whole], np.maximum(speed, 0.0), accel, spacing, name, "; ".join(notes))


def _longest(known: BoolArray, near: BoolArray) -> slice | None:
    """The longest run of rows that are known and near to each other, at least two."""
    linked = known[1:] & known[:-1] & near
    edges = np.flatnonzero(np.diff(np.concatenate([[False], linked, [False]]).astype(int)))
    if len(edges) == 0:
        return None
    starts, stops = edges[::2], edges[1::2]
    best = int(np.argmax(stops - starts))
    return slice(int(starts[best]), int(stops[best]) + 1)
