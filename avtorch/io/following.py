"""Recorded followers as logs: a car with the spacing and the speed of the one ahead, and no command."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np

from avtorch.arrays import FloatArray
from avtorch.errors import InputError, listed
from avtorch.io.leaders import NO_LEADER_M, numbered, recorded, vehicle_order
from avtorch.io.log import Log
from avtorch.io.mapping import Pairs
from avtorch.io.tables import Table, read_table

_LONG_STEP_S = 0.25
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
    if any(n.startswith("SpeedDoppler") for n in names):
        _idle(table.source, event=event, **columns)
        numbers = numbered("SpeedDoppler", names)
        own = _chosen(table.source, vehicle, [n for n in numbers if n - 1 in numbers and f"Spacing{n}" in names])
        return _log(table, f"SpeedDoppler{own}", f"Spacing{own}", f"SpeedDoppler{own - 1}", f"vehicle {own}")
    if "Time" in names and numbered("Speed", names):
        _idle(table.source, event=event, **columns)
        numbers = numbered("Speed", names)
        own = _chosen(table.source, vehicle, [n for n in numbers if n - 1 in numbers and f"IVS{n - 1}" in names])
        makes = vehicle_order(Path(path))
        make = f" ({makes[own - 1]})" if own <= len(makes) else ""
        return _log(table, f"Speed{own}", f"IVS{own - 1}", f"Speed{own - 1}", f"vehicle {own}{make}")
    if {"Time", "Velocity", "SpaceGap", "RelativeVelocity"} <= names:
        _idle(table.source, vehicle=vehicle, event=event, **columns)
        return _instrumented(table)
    if {"event", "time", "spacing", "speed", "lead_speed"} <= names:
        _idle(table.source, vehicle=vehicle, **columns)
        return _event(table, event)
    _idle(table.source, vehicle=vehicle, event=event)
    return Log.read(path, map=map, unit=unit, stamp=stamp, following=True)


def _idle(source: str, **given: object) -> None:
    for option, value in given.items():
        if value is not None:
            argument = f"{option} {value}" if isinstance(value, int) else option
            raise InputError(f"{source}: {argument} has no meaning for a file of this form")


def _chosen(source: str, vehicle: int | None, followers: list[int]) -> int:
    if not followers:
        raise InputError(f"{source}: no vehicle has a spacing to one ahead whose speed is there")
    if vehicle is None:
        return followers[0]
    if vehicle not in followers:
        known = listed(map(str, followers))
        raise InputError(f"{source}: vehicle {vehicle} follows nobody in it; followers: {known}")
    return vehicle


def _log(table: Table, speed: str, spacing: str, lead: str, who: str) -> Log:
    def column(name: str) -> FloatArray:
        return table.numbers(name, empty_is_nan=True)

    name = f"{Path(table.source).stem}, {who}"
    return _whole(name, table.numbers("Time"), column(speed), column(spacing), column(lead))


def _instrumented(table: Table) -> Log:
    speed = table.numbers("Velocity", empty_is_nan=True) / 3.6
    gap = table.numbers("SpaceGap", empty_is_nan=True)
    lead = speed + table.numbers("RelativeVelocity", empty_is_nan=True)
    gap = np.where(gap >= NO_LEADER_M, np.nan, gap)
    return _whole(Path(table.source).stem, table.numbers("Time"), speed, gap, lead)


def _event(table: Table, event: int | None) -> Log:
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
    linked = known[1:] & known[:-1] & (steps <= _LONG_STEP_S) & (steps > 0)
    with np.errstate(invalid="ignore"):
        jumped = np.abs(np.diff(spacing) - steps * (lead - speed)[:-1]) > _JUMP_M
    linked &= ~jumped
    edges = np.flatnonzero(np.diff(np.concatenate([[False], linked, [False]]).astype(int)))
    if not len(edges):
        raise InputError(f"{name}: no two rows in a row hold speed, spacing and the leader's speed")
    best = int(np.argmax(edges[1::2] - edges[::2]))
    part = slice(int(edges[::2][best]), int(edges[1::2][best]) + 1)
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
