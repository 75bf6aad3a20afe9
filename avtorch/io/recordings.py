"""Recorded leaders in any of the known forms, recognised by their header."""

from __future__ import annotations

import os
from pathlib import Path

from avtorch.errors import InputError, listed
from avtorch.io import i24, ngsim, openacc
from avtorch.io.mapping import Pairs, pairs
from avtorch.io.raw_leader import RawLeader, checked_leader
from avtorch.io.recorded_columns import recorded
from avtorch.io.tables import Table, read_table
from avtorch.io.units import to_si


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

    Example:
        >>> import numpy as np
        >>> from avtorch.io import read_leader
        >>> time = np.arange(0.0, 5.0, 0.1)
        >>> np.savetxt("lead.csv", np.c_[time, 72 - 3.6 * time], delimiter=",", header="time,speed", comments="")
        >>> leader = read_leader("lead.csv", unit="speed=km/h")
        >>> [round(v, 1) for v in leader.speed[[0, -1]].tolist()]
        [20.0, 15.1]
    """
    table = read_table(path, header="Time", wanted=recorded)
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
    elif not {"speed", "lead_speed"} & names or "time" not in names:
        raise InputError(
            f"{table.source}: is no leader file; it needs columns time and speed, or the form of OpenACC, NGSIM or "
            f"I-24; columns: {listed(table.names)}"
        )
    _refuse_idle(table.source, form, vehicle=vehicle, event=event, duration=duration, unit=unit)
    if not table.rows:
        raise InputError(f"{table.source}: found a header but no rows; needs a recording")
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
