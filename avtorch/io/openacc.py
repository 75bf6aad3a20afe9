"""OpenACC platoons (European Commission, Joint Research Centre): the AstaZero form and the raw ZalaZONE form."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Iterable
from itertools import islice
from pathlib import Path

from avtorch.errors import InputError, listed, printable
from avtorch.io.opening import place
from avtorch.io.raw_leader import RawLeader, checked_leader
from avtorch.io.tables import Table, read_bytes
from avtorch.io.text.encoding import decoded


def numbered(stem: str, names: Iterable[str]) -> list[int]:
    """The vehicle numbers of the columns ``stem`` + number, rising; numbers can skip."""
    found = (re.fullmatch(rf"{stem}([0-9]{{1,6}})", name) for name in names)
    return sorted(int(match[1]) for match in found if match)


def astazero(table: Table, vehicle: int | None = None) -> RawLeader:
    """A vehicle of the AstaZero form: ``Time, X_i, SpeedDoppler_i, Accel_i, Spacing_i`` (to the vehicle ahead)."""
    number = _choose(table, "SpeedDoppler", vehicle)
    columns = {"time": "Time", "speed": f"SpeedDoppler{number}"}
    accel = spacing = None
    if f"Accel{number}" in table.names:
        columns["accel"] = f"Accel{number}"
        accel = table.numbers(columns["accel"], empty_is_nan=True)
    if f"Spacing{number}" in table.names:
        spacing = table.numbers(f"Spacing{number}", empty_is_nan=True)
    return checked_leader(
        table,
        table.numbers("Time"),
        table.numbers(columns["speed"], empty_is_nan=True),
        accel,
        spacing,
        columns=columns,
        name=f"{Path(table.source).stem}, vehicle {number}",
    )


def zalazone(table: Table, vehicle: int | None = None, order: tuple[str, ...] = ()) -> RawLeader:
    """A vehicle of the ZalaZONE form: header lines, then ``Time, Speed_i, E_i, N_i, Alt_i, IVS_i``.

    Vehicle numbers can skip and cells can be empty. ``IVS_i`` is the spacing between vehicles i and i + 1, so a
    vehicle's spacing to the one ahead bears the number before its own. ``order``: the makes, by number, from the file's
    header.
    """
    number = _choose(table, "Speed", vehicle)
    speed = f"Speed{number}"
    ahead = f"IVS{number - 1}"
    make = order[number - 1] if 0 < number <= len(order) else ""
    return checked_leader(
        table,
        table.numbers("Time"),
        table.numbers(speed, empty_is_nan=True),
        None,
        table.numbers(ahead, empty_is_nan=True) if ahead in table.names else None,
        columns={"time": "Time", "speed": speed},
        name=f"{Path(table.source).stem}, vehicle {number}" + (f" ({make})" if make else ""),
    )


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
