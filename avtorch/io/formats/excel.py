"""Workbooks by python-calamine: Excel (xlsx, xlsm, xlsb, xls) and OpenDocument (ods), the first sheet with a table.

A table is a row of names, perhaps a row of units below it, then rows of numbers.
"""

from __future__ import annotations

import datetime as dt
import io
import math
import os
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import chain, islice
from typing import Any

import numpy as np

from avtorch.arrays import FloatArray
from avtorch.errors import InputError, listed, quoted
from avtorch.io.formats.kinds import Kind, guarded, library
from avtorch.io.formats.listed import Channel, Listed, refuse_cells
from avtorch.io.formats.matlab import FINER, TIMES
from avtorch.io.opening import MOST_BYTES, MOST_COLUMNS, place, read_regular

_NEED = "an undamaged workbook"
_SCALES = {"s": 1.0, "sec": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0}
_AHEAD = 200  # rows searched for the names
_EPOCH = dt.datetime(1970, 1, 1)
_UNIT = re.compile(r"\s*(?:\[([^\]]*)\]|\(([^)]*)\))\s*$")


@dataclass(frozen=True)
class SheetTable:
    """Names, units and numbers ``(row, column)`` of a sheet; NaN for an empty cell and for a text."""

    names: tuple[str, ...]
    units: dict[str, str]
    numbers: FloatArray
    texts: int
    """Cells among the numbers that hold a text."""


def open_file(path: str | os.PathLike[str], kind: Kind) -> Listed:
    """Open a workbook; the sheet is read at once.

    Channels are its columns of numbers, called as in the row of names; NaN for an empty cell or a text. Time is the
    column called time, t, timestamp or the like, in seconds unless its unit says otherwise, since 1970 where its cells
    are dates. Rows without a time are left out. Raises InputError.
    """
    source = place(path)
    calamine = library("python_calamine", source, kind)
    with guarded(source, _NEED):
        book = calamine.load_workbook(io.BytesIO(read_regular(path, most=MOST_BYTES, need=_NEED)))
        sheets = list(book.sheet_names)
        tables = ((name, table_of(book.get_sheet_by_name(name).iter_rows(), source)) for name in sheets)
        sheet, table = next(((name, one) for name, one in tables if one is not None and one.names), ("", None))
    if table is None:
        raise InputError(
            f"{source}: no sheet has a row of names and rows of numbers below it; sheets: {listed(sheets)}"
        )
    plain = [_UNIT.sub("", name).strip().lower() for name in table.names]
    at = next((plain.index(name) for name in (*TIMES, *FINER) if name in plain), None)
    if at is None:
        raise InputError(
            f"{source}: no column is called {', '.join(TIMES[:4])} or the like; a time column is needed; "
            f"columns: {listed(table.names)}"
        )
    scale = _SCALES.get(table.units.get(table.names[at], "").lower(), FINER.get(plain[at], 1.0))
    time = table.numbers[:, at] * scale
    dated = ~np.isnan(time)
    remarks = []
    if len(sheets) > 1:
        remarks.append(f"sheet {quoted(sheet)} is read, {len(sheets) - 1} others are not")
    if table.texts:
        remarks.append(f"{table.texts} cells hold a text where a number is expected; they are NaN")
    if not dated.all():
        remarks.append(f"{int((~dated).sum())} rows without a time are left out")
    time = time[dated]
    columns = {name: table.numbers[dated, i] for i, name in enumerate(table.names) if i != at}
    units = {name: unit for name, unit in table.units.items() if name in columns}
    return Listed(
        source, kind.words, columns, units, remarks,
        lambda names: {name: Channel(name, time, columns[name]) for name in names},
    )  # fmt: skip


def table_of(rows: Iterable[Sequence[Any]], source: str) -> SheetTable | None:
    """The table of a sheet, None where there is none. Columns without any number are left out.

    Raises InputError beyond 10,000 columns or 20 million cells.
    """
    left = iter(rows)
    ahead = list(islice(left, _AHEAD))
    for i, row in enumerate(ahead):
        if not _is_header(row):
            continue
        below = next((k for k in range(i + 1, min(i + 3, len(ahead))) if _numbers(ahead[k]) >= 1), None)
        if below is None or (below == i + 2 and _numbers(ahead[i + 1])):
            continue
        return _table(row, ahead[i + 1] if below == i + 2 else (), chain(ahead[below:], left), source)
    return None


def _is_header(row: Sequence[Any]) -> bool:
    texts = [cell for cell in row if cell != ""]
    return len(texts) >= 2 and all(isinstance(cell, str) for cell in texts)


def _numbers(row: Sequence[Any]) -> int:
    return sum(not isinstance(cell, str) for cell in row)


def _table(head: Sequence[str], below: Sequence[Any], rows: Iterable[Sequence[Any]], source: str) -> SheetTable:
    places = [i for i, name in enumerate(head) if name.strip()]
    if len(places) > MOST_COLUMNS:
        raise InputError(f"{source}: has {len(places):,} columns; needs {MOST_COLUMNS:,} at most")
    lines: list[list[float]] = []
    texts = [0] * len(places)
    for row in rows:
        if all(cell == "" for cell in row):
            continue
        refuse_cells(source, (len(lines) + 1) * len(places))
        line = [_number(row[i]) if i < len(row) else math.nan for i in places]
        for k, i in enumerate(places):
            texts[k] += i < len(row) and isinstance(row[i], str) and row[i] != "" and math.isnan(line[k])
        lines.append(line)
    numbers = np.array(lines, dtype=np.float64).reshape(len(lines), len(places))
    kept = ~np.all(np.isnan(numbers), axis=0)
    names: list[str] = []
    units: dict[str, str] = {}
    for i, is_number in zip(places, kept, strict=True):
        if not is_number:
            continue
        name = base = head[i].strip()
        count = 1
        while name in names:
            count += 1
            name = f"{base} ({count})"
        names.append(name)
        unit = str(below[i]).strip() if i < len(below) else ""
        if not unit and (match := _UNIT.search(base)) is not None:
            unit = (match[1] if match[1] is not None else match[2]).strip()
        unit = unit.strip("[]() ")
        if unit:
            units[name] = unit
    return SheetTable(tuple(names), units, numbers[:, kept], sum(n for n, k in zip(texts, kept, strict=True) if k))


def _number(cell: Any) -> float:
    """A cell as a number: a date in seconds since 1970, a time of day or a span in seconds."""
    if isinstance(cell, (bool, int, float)):
        return float(cell)
    if isinstance(cell, dt.datetime):
        return (cell.replace(tzinfo=None) - _EPOCH) / dt.timedelta(seconds=1)
    if isinstance(cell, dt.date):
        return (dt.datetime(cell.year, cell.month, cell.day) - _EPOCH) / dt.timedelta(seconds=1)
    if isinstance(cell, dt.timedelta):
        return cell / dt.timedelta(seconds=1)
    if isinstance(cell, dt.time):
        return cell.hour * 3600 + cell.minute * 60 + cell.second + cell.microsecond / 1e6
    try:
        return float(cell)
    except ValueError:
        return math.nan
