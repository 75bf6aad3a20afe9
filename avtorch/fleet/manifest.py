"""A manifest: a CSV file that names the logs of a fleet, their cars and dates, and whatever else is known of them."""

from __future__ import annotations

import csv
import io
import os
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from avtorch.errors import InputError, listed, quoted
from avtorch.fleet.places import fetched, is_url
from avtorch.io.opening import TooLarge, place, read_regular

MOST = 256 * 2**20
"""Most bytes of a manifest."""
_HEAD = 4096
NEED = "a header such as log,car,date"


@dataclass(frozen=True)
class ManifestRow:
    """A line of a manifest: the place of a log, its car, its date as ISO 8601 or None, and further columns."""

    log: str
    car: str
    date: str | None
    tags: dict[str, str]


def is_manifest(source: str) -> bool:
    """Whether a file is a manifest and no log: a `.csv` whose header has `log`, and `car` or no `time` as logs have."""
    if not source.lower().endswith(".csv"):
        return False
    try:
        if is_url(source):
            with fetched(source) as local:
                head = _head(local)
        else:
            head = _head(Path(source))
    except (InputError, OSError, ValueError):
        return False
    try:
        names = [name.strip().lower() for name in next(csv.reader([head], delimiter=_delimiter(head)), [])]
    except csv.Error:
        return False
    return "log" in names and ("car" in names or "time" not in names)


def _delimiter(head: str) -> str:
    """What separates the columns of a header: a comma, or the semicolon of spreadsheets where the comma is decimal."""
    return ";" if ";" in head and "," not in head else ","


def _head(path: Path) -> str:
    if not path.is_file():
        return ""
    with path.open("rb") as stream:
        return stream.read(_HEAD).decode("utf-8-sig", "replace").partition("\n")[0]


def read_manifest(source: str) -> list[ManifestRow]:
    """The rows of a manifest; relative paths of logs are relative to its folder.

    Raises `InputError` naming file, line and column: for a missing or doubled column, a line of another length, an
    empty log or car, a log given twice, and a date that is not ISO 8601.
    """
    shown = place(source)
    with fetched(source) as local:
        try:
            raw = read_regular(local, most=MOST, need="a manifest")
        except TooLarge as fault:
            raise InputError(f"{fault}; split the fleet") from None
    try:
        text = raw.decode("utf-8-sig")
    except UnicodeDecodeError as fault:
        line = raw.count(b"\n", 0, fault.start) + 1
        raise InputError(f"{shown}: line {line}: is not UTF-8; a manifest is a CSV file in UTF-8") from None
    reader = csv.reader(io.StringIO(text), delimiter=_delimiter(text.partition("\n")[0]), strict=True)
    rows: list[ManifestRow] = []
    first: dict[str, int] = {}
    try:
        names = [name.strip() for name in next(reader, [])]
        for column in ("log", "car"):
            if column not in names:
                raise InputError(f"{shown}: line 1: has no column {column}; needs {NEED}, found {listed(names)}")
        if len(set(names)) < len(names) or not all(names):
            raise InputError(f"{shown}: line 1: found {listed(names)}, needs a name of its own for each column")
        for cells in reader:
            if not any(cell.strip() for cell in cells):
                continue
            where = f"{shown}: row {len(rows) + 1} (line {reader.line_num})"
            row = _row(source, where, names, cells)
            same = row.log if is_url(row.log) else os.path.abspath(row.log)
            if same in first:
                raise InputError(f"{where}, column log: {quoted(row.log)} is already in row {first[same]}")
            rows.append(row)
            first[same] = len(rows)
    except csv.Error as fault:
        raise InputError(f"{shown}: line {reader.line_num}: is no CSV ({fault})") from None
    if not rows:
        raise InputError(f"{shown}: has no row below its header; needs a log in each")
    return rows


def _row(source: str, where: str, names: list[str], cells: list[str]) -> ManifestRow:
    if len(cells) != len(names):
        raise InputError(f"{where}: has {len(cells)} cells, needs {len(names)}, as the header has")
    entry = {name: cell.strip() for name, cell in zip(names, cells, strict=True)}
    for column in ("log", "car"):
        if not entry[column]:
            raise InputError(f"{where}, column {column}: is empty; needs {'a path' if column == 'log' else 'a name'}")
    log, car, date = entry.pop("log"), entry.pop("car"), entry.pop("date", "")
    if date:
        try:
            datetime.fromisoformat(date)
        except ValueError:
            raise InputError(
                f"{where}, column date: found {quoted(date)}, needs a date such as 2026-11-23 or 2026-11-23T08:30"
            ) from None
    if not is_url(log) and not os.path.isabs(log):
        parent = source.rpartition("/")[0] if is_url(source) else os.path.dirname(source)
        log = f"{parent}/{log}" if is_url(source) else os.path.normpath(os.path.join(parent, log))
    return ManifestRow(log, car, date or None, {key: value for key, value in entry.items() if value})
