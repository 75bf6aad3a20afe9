"""Workbooks by python-calamine: Excel (xlsx, xlsm, xlsb, xls) and OpenDocument (ods), the first sheet with a table."""

from __future__ import annotations

import io
import os
import zipfile
import zlib
from collections.abc import Mapping, Sequence

import numpy as np

from avtorch.arrays import FloatArray
from avtorch.errors import InputError, listed, quoted
from avtorch.io.formats import kinds
from avtorch.io.formats.excel_table import SheetTable, bare, table_of
from avtorch.io.formats.kinds import Kind
from avtorch.io.formats.library import guarded, library
from avtorch.io.formats.listed import Listed
from avtorch.io.formats.mat_tree import FINER, TIMES
from avtorch.io.opening import place, read_regular
from avtorch.io.recording import Channel
from avtorch.io.size import MOST_BYTES

_NEED = "an undamaged workbook"
_MOST_INFLATED = 2 * 2**30  # bytes of all parts of a workbook
_SCALES = {"s": 1.0, "sec": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0}


class ExcelRecording(Listed):
    """A sheet. Channels are its columns of numbers, called as in the row of names; NaN for an empty cell or a text.

    Time is the column called time, t, timestamp or the like, in seconds unless its unit says otherwise, since 1970
    where its cells are dates. Rows without a time are left out.
    """

    def __init__(
        self,
        source: str,
        form: str,
        time: FloatArray,
        columns: Mapping[str, FloatArray],
        units: Mapping[str, str],
        remarks: Sequence[str],
    ) -> None:
        super().__init__(source, form, columns, units, remarks)
        self._time, self._columns = time, columns

    def _read(self, names: tuple[str, ...]) -> dict[str, Channel]:
        time = self._time.copy()
        return {name: Channel(name, time, self._columns[name].copy()) for name in names}


def open_file(path: str | os.PathLike[str], kind: Kind) -> ExcelRecording:
    """Open a workbook; the sheet is read at once. Raises InputError."""
    source = place(path)
    raw = read_regular(path, most=MOST_BYTES, need=_NEED)
    if kind is not kinds.XLS:
        _check_zip(raw, source)
    sheet, others, table = _first_table(raw, source, kind)
    names, units, values = table.names, table.units, table.numbers.T
    time_at = _time_column(names, source)
    scale = _scale(names[time_at], units)
    time = values[time_at] * scale if scale != 1.0 else values[time_at]
    dated = ~np.isnan(time)
    remarks = []
    if others:
        remarks.append(f"sheet {quoted(sheet)} is read, {others} others are not")
    if table.texts:
        remarks.append(f"{table.texts} cells hold a text where a number is expected; they are NaN")
    if not dated.all():
        remarks.append(f"{int((~dated).sum())} rows without a time are left out")
    columns = {name: values[i][dated] for i, name in enumerate(names) if i != time_at}
    units = {name: unit for name, unit in units.items() if name in columns}
    return ExcelRecording(source, kind.words, time[dated], columns, units, remarks)


def _time_column(names: Sequence[str], source: str) -> int:
    plain = [bare(name) for name in names]
    for wanted in (*TIMES, *FINER):
        if wanted in plain:
            return plain.index(wanted)
    raise InputError(
        f"{source}: no column is called {', '.join(TIMES[:4])} or the like; a time column is needed; "
        f"columns: {listed(names)}"
    )


def _scale(name: str, units: Mapping[str, str]) -> float:
    unit = units.get(name, "").lower()
    return _SCALES.get(unit, FINER.get(bare(name), 1.0))


def _check_zip(raw: bytes, source: str) -> None:
    """Every part inflates to what the file says, and all of them to a bounded size."""
    try:
        with zipfile.ZipFile(io.BytesIO(raw)) as archive:
            parts = archive.infolist()
            total = sum(part.file_size for part in parts)
            if total > _MOST_INFLATED or len(parts) > 10_000:
                raise InputError(f"{source}: {len(parts):,} parts of {total:,} bytes; needs {_MOST_INFLATED:,} at most")
            # reads each part in pieces, no further than it claims to go
            broken = archive.testzip()
    except (zipfile.BadZipFile, zlib.error, OSError, ValueError, EOFError, NotImplementedError, RuntimeError) as fault:
        raise InputError(f"{source}: is damaged ({type(fault).__name__}: {fault}); {_NEED} is needed") from None
    if broken is not None:
        raise InputError(f"{source}: its part {quoted(broken)} is damaged; {_NEED} is needed")


def _first_table(raw: bytes, source: str, kind: Kind) -> tuple[str, int, SheetTable]:
    """The first sheet that holds a table, and the number of the other sheets."""
    calamine = library("python_calamine", source, kind)
    with guarded(source, _NEED):
        book = calamine.load_workbook(io.BytesIO(raw))
        sheets = list(book.sheet_names)
        for name in sheets:
            table = table_of(book.get_sheet_by_name(name).iter_rows(), source)
            if table is not None and table.names:
                return name, len(sheets) - 1, table
    raise InputError(f"{source}: no sheet has a row of names and rows of numbers below it; sheets: {listed(sheets)}")
