"""Workbooks by python-calamine: Excel (xlsx, xlsm, xlsb, xls) and OpenDocument (ods), the first sheet with a table.

A sheet is read as a table of text is (`avtorch.io.tables`): lines before the header, a row of names, perhaps a row of
units, rows of numbers.
"""

from __future__ import annotations

import csv
import datetime as dt
import io
import os
import re
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from avtorch.errors import InputError, listed, quoted
from avtorch.io.formats.kinds import Kind, guarded, library
from avtorch.io.formats.listed import Channel, Recording, refuse_cells
from avtorch.io.formats.matlab import FINER, TIMES
from avtorch.io.opening import MOST_BYTES, place, read_regular
from avtorch.io.tables import Readings, Table, text_table
from avtorch.io.units import factor, stated_unit

_NEED = "an undamaged workbook"
_UNIT = re.compile(r"\s*(?:\[([^\]]*)\]|\(([^)]*)\))\s*$")


def open_file(path: str | os.PathLike[str], kind: Kind) -> Recording:
    """Open a workbook; the sheet is read at once.

    Channels are its columns of numbers, called as in the row of names; NaN for an empty cell or a text. Time is the
    column called time, t, timestamp or the like, in seconds unless its unit says otherwise, since 1970 where its cells
    are dates. Rows without a time and columns that share a name are left out. Raises InputError.
    """
    source = place(path)
    calamine = library("python_calamine", source, kind)
    with guarded(source, _NEED):
        book = calamine.load_workbook(io.BytesIO(read_regular(path, most=MOST_BYTES, need=_NEED)))
        sheets = list(book.sheet_names)
        tables = ((name, sheet_table(book.get_sheet_by_name(name).iter_rows(), source)) for name in sheets)
        sheet, found = next(((name, one) for name, one in tables if one is not None), ("", None))
    if found is None:
        raise InputError(
            f"{source}: no sheet has a row of names and rows of numbers below it; sheets: {listed(sheets)}"
        )
    table, columns = found
    bracketed = {name: match[1] or match[2] for name in columns if (match := _UNIT.search(name)) is not None}
    units = {name: unit for name in columns if (unit := table.units.get(name) or bracketed.get(name))}
    plain = {_UNIT.sub("", name).strip().lower(): name for name in reversed(columns)}
    clock = next((name for name in (*TIMES, *FINER) if name in plain), None)
    if clock is None:
        raise InputError(
            f"{source}: no column is called {', '.join(TIMES[:4])} or the like; a time column is needed; "
            f"columns: {listed(columns)}"
        )
    stated = stated_unit("time", units.pop(plain[clock], ""))
    time = columns.pop(plain[clock]).values * (factor("time", stated) if stated else FINER.get(clock, 1.0))
    dated = ~np.isnan(time)
    time = time[dated]
    remarks = []
    if len(sheets) > 1:
        remarks.append(f"sheet {quoted(sheet)} is read, {len(sheets) - 1} others are not")
    if twice := sorted({name for name in table.names if table.names.count(name) > 1}):
        remarks.append(f"columns that share a name are left out: {listed(twice)}")
    if texts := sum(len(column.faults) for column in columns.values()):
        remarks.append(f"{texts} cells hold a text where a number is expected; they are NaN")
    if not dated.all():
        remarks.append(f"{int((~dated).sum())} rows without a time are left out")
    return Recording(
        source, kind.words, columns, {name: unit.strip("[]() ") for name, unit in units.items()}, remarks,
        lambda names: {name: Channel(name, time, columns[name].values[dated]) for name in names},
    )  # fmt: skip


def sheet_table(rows: Iterable[Sequence[Any]], source: str) -> tuple[Table, dict[str, Readings]] | None:
    """The table of a sheet and its columns of numbers or times; None where it has none."""
    text, cells = io.StringIO(newline=""), 0
    writer = csv.writer(text, delimiter="\t")
    for row in rows:
        cells += len(row)
        refuse_cells(source, cells)
        writer.writerow(map(_text, row))
    try:
        table = text_table(source, text.getvalue(), None)
    except InputError:  # no row of names
        return None
    columns = {
        name: table.readings(name, empty_is_nan=True, as_time=True)
        for name in table.names
        if table.names.count(name) == 1
    }
    columns = {name: column for name, column in columns.items() if np.isfinite(column.values).any()}
    return (table, columns) if columns else None


def _text(cell: Any) -> str:
    """A cell as text: a number in full, a span in seconds, a date or a time of day in ISO's form."""
    if isinstance(cell, dt.datetime):
        return cell.replace(tzinfo=None).isoformat()
    if isinstance(cell, dt.date):
        return f"{cell.isoformat()}T00:00:00"
    if isinstance(cell, dt.time):
        return cell.isoformat()
    if isinstance(cell, dt.timedelta):
        return repr(cell / dt.timedelta(seconds=1))
    return repr(float(cell)) if isinstance(cell, (bool, int, float)) else str(cell or "")
