"""CSV and Parquet files, and data frames, as named columns of numbers, with errors that name the row and the column."""

from __future__ import annotations

import io
import math
import os
import re
from array import array
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from avtorch.arrays import FloatArray
from avtorch.errors import InputError, listed, quoted
from avtorch.io.formats.apart import Wanted, parquet_apart
from avtorch.io.formats.kinds import reason
from avtorch.io.opening import MOST_BYTES, MOST_CELLS, MOST_COLUMNS, beginning, place, read_regular
from avtorch.io.text import decoded, is_time, is_value, layout_of, rows_of, seconds_of, unzipped
from avtorch.numeral import numeral

Cells = Sequence[Any] | NDArray
_NEED = "a CSV or Parquet file"


@dataclass(eq=False)
class Table:
    """Named columns of one file, cells not yet parsed as numbers; None for a column that was not requested.

    A stamp in two columns, of seconds and of nanoseconds, is one column more (`whole_stamps`). Messages name rows as
    ``row 3 (line 4)``: the third row of data, and the line an editor shows. A Parquet file and arrays have no lines.
    ``decimal`` is the mark in cells of text; ``units`` are those of a row of units, by column; ``faults``: rows that
    are no rows, such as one cut off, with what is wrong; ``remarks``: what was guessed; ``form``: the file's format in
    words.
    """

    source: str
    names: tuple[str, ...]
    cells: tuple[Cells | None, ...]
    lines: Sequence[int] | None = None
    decimal: str = "."
    units: Mapping[str, str] = field(default_factory=dict)
    faults: Mapping[int, str] = field(default_factory=dict)
    remarks: tuple[str, ...] = ()
    form: str = "a table"

    def __post_init__(self) -> None:
        self.source = place(self.source)
        cells = dict(zip(self.names, self.cells, strict=True))
        for name, halves in whole_stamps(self.names).items():
            if name not in cells:
                self.names = (*self.names, name)
                self.cells = (*self.cells, _whole(*(cells[half] for half in halves)))

    @property
    def rows(self) -> int:
        return next((len(cells) for cells in self.cells if cells is not None), 0)

    def where(self, row: int, column: str | None = None) -> str:
        """The place of a row, or of its cell, in words; ``row`` counts from 0."""
        line = f" (line {self.lines[row]})" if self.lines is not None else ""
        cell = "" if column is None else f", column {quoted(column)}"
        return f"{self.source}: row {row + 1}{line}{cell}"

    def numbers(self, column: str, *, empty_is_nan: bool = False) -> FloatArray:
        """A column as float64, ``(row,)``.

        Raises InputError naming row and column for an empty cell (unless ``empty_is_nan``), text, NaN and infinity.
        """
        read = self.readings(column, empty_is_nan=empty_is_nan)
        if read.faults:
            row = min(read.faults)
            raise InputError(read.faults[row])
        return read.values

    def readings(
        self, column: str, *, empty_is_nan: bool = False, as_time: bool = False, as_state: bool = False
    ) -> Readings:
        """A column as float64, NaN where a cell is no finite number, and what is wrong with each such cell.

        An empty cell is no fault where ``empty_is_nan``. Texts may be dates and times of day where ``as_time``, and
        true and false, on and off, yes and no where ``as_state``.
        """
        count = self.names.count(column)
        if count != 1:
            what = "is missing" if count == 0 else f"occurs {count} times"
            raise InputError(f"{self.source}: column {quoted(column)} {what}; columns: {listed(self.names)}")
        cells = self.cells[self.names.index(column)]
        if cells is None:
            raise KeyError(f"column {column!r} was not among the wanted ones")
        faults: dict[int, str] = {row: f"{self.where(row)}: {what}" for row, what in self.faults.items()}
        if isinstance(cells, np.ndarray):
            values = np.array(cells, dtype=np.float64)
            empty = np.zeros(len(values), dtype=bool)
        elif as_time and is_time(next((c for c in cells if isinstance(c, str) and c.strip()), "")):
            values = seconds_of([cell if isinstance(cell, str) else "" for cell in cells])
            for row in np.flatnonzero(np.isnan(values)).tolist():
                if row not in faults:
                    faults[row] = f"{self.where(row, column)}: {quoted(str(cells[row]), 30)} is no time"
            empty = np.isnan(values)
        else:
            need = _TIME if as_time else "a number is needed"
            values, empty = self._parse(cells, column, empty_is_nan, as_state, faults, need)
        for row in np.flatnonzero(~np.isfinite(values) & ~empty).tolist():
            if row not in faults:
                word = "NaN" if math.isnan(values[row]) else "infinite"
                faults[row] = f"{self.where(row, column)}: is {word}; a finite number is needed"
        values[~np.isfinite(values)] = math.nan
        values[list(faults)] = math.nan
        return Readings(values, faults)

    def _parse(
        self,
        cells: Sequence[Any],
        column: str,
        empty_is_nan: bool,
        as_state: bool,
        faults: dict[int, str],
        need: str,
    ) -> tuple[FloatArray, NDArray]:
        values = np.full(len(cells), math.nan)
        empty = np.zeros(len(cells), dtype=bool)
        for row, cell in enumerate(cells):
            try:
                values[row] = self._numeral(cell) if isinstance(cell, str) else _number(cell)
            except (TypeError, ValueError):
                empty[row] = True
                blank = cell is None or (isinstance(cell, str) and not cell.strip())
                if row in faults or (blank and empty_is_nan):
                    continue
                if as_state and isinstance(cell, str) and cell.strip().lower() in _STATES:
                    values[row] = _STATES[cell.strip().lower()]
                elif blank:
                    faults[row] = f"{self.where(row, column)}: is empty; {need}"
                else:
                    faults[row] = f"{self.where(row, column)}: {_no_number(cell, need)}"
        return values, empty

    def _numeral(self, cell: str) -> float:
        if self.decimal == "," and "." not in cell:
            cell = cell.replace(",", ".", 1)
        return numeral(cell)


@dataclass(frozen=True, eq=False)
class Readings:
    """``values`` (row,), NaN where nothing was read; ``faults``: what is wrong with a cell, by row."""

    values: FloatArray
    faults: Mapping[int, str]


_TIME = "a time is needed: a number, or as 2024-04-23 12:31:47.388 or 12:31:47.388"
_STATES = {"true": 1.0, "false": 0.0, "on": 1.0, "off": 0.0, "yes": 1.0, "no": 0.0}


def _number(cell: Any) -> float:
    """A cell that is not text: an integer may be too large, and bytes are text not yet decoded."""
    if isinstance(cell, (bytes, bytearray)):
        raise TypeError
    try:
        return float(cell)
    except OverflowError:
        return math.inf


def _no_number(cell: Any, need: str) -> str:
    if not isinstance(cell, str):
        return f"a {type(cell).__name__} is no number; {need}"
    if need == _TIME and not is_time(cell):
        return f"{quoted(cell, 30)} is no number, and no time of a known form; {need}"
    return f"{quoted(cell, 30)} is no number; a number is needed"


def read_table(path: str | os.PathLike[str], *, wanted: Wanted = None) -> Table:
    """Read a table of text or a Parquet file, of the columns only those that are `wanted` (default: all).

    Text is UTF-8, UTF-16 or Windows-1252, may be gzipped, and has its separator, decimal mark, comments and row of
    units found (`avtorch.io.text`). Unnamed columns get the name ``(unnamed 1)`` by position. Lines end at ``\\n``,
    ``\\r\\n`` or ``\\r`` and nowhere else; empty ones are skipped. A row with too few or too many cells is a fault of
    the table. Raises InputError for any other file: missing, not a regular file, empty, binary, no header, and beyond
    512 MiB, 10,000 columns, 1,000,000 characters in a row, or 20 million cells in the wanted columns.
    """
    file = Path(path)
    if wanted is not None and not isinstance(wanted, re.Pattern):
        wanted = {half for name in wanted for half in (name, *name.split(_AND))}
    if beginning(file, 4, need=_NEED) == b"PAR1":
        return _parquet(file, wanted)
    raw = unzipped(place(file), read_regular(file, most=MOST_BYTES, need=_NEED))
    if not raw.strip():
        raise InputError(f"{place(file)}: is empty; a header line and rows are needed")
    if file.suffix.lower() in (".parquet", ".pq"):
        raise InputError(f"{place(file)}: named as Parquet but its content is not; write it anew, or name it .csv")
    text, remarks = decoded(place(file), raw)
    return replace(text_table(place(file), text, wanted), remarks=remarks)


def _parquet(file: Path, wanted: Wanted) -> Table:
    from avtorch.io.formats.parquet import cells_of

    names, columns = parquet_apart(file, wanted)
    where = f"{place(file)}: column"
    read = {name: cells_of(columns.column(name), f"{where} {quoted(name)}") for name in columns.column_names}
    return Table(place(file), names, tuple(read.get(name) for name in names), form="Parquet")


def text_table(source: str, text: str, wanted: Wanted) -> Table:
    """A table of text, by its own layout."""
    layout = layout_of(io.StringIO(text, newline=""))
    rows = rows_of(source, text, layout)
    names = _names(source, next(rows, None))
    if isinstance(wanted, re.Pattern):
        wanted = [name for name in names if wanted.fullmatch(name)]
    kept = [i for i, name in enumerate(names) if wanted is None or name in wanted]
    stated = next(rows, ([], 0))[0] if layout.units else []
    units = {name: unit.strip() for name, unit in zip(names, stated, strict=False) if unit.strip()}
    columns: list[list[str]] = [[] for _ in kept]
    lines, faults = array("q"), {}
    for row, line in rows:
        if (len(lines) + 1) * max(1, len(kept)) > MOST_CELLS:
            many = f"{MOST_CELLS // max(1, len(kept)):,} rows of {len(kept)} columns that are read"
            raise InputError(f"{source}: has more than {many}; split it")
        if len(row) != len(names):
            faults[len(lines)] = f"has {len(row)} cells where the header has {len(names)}"
            row = [""] * len(names)
        for i, column in zip(kept, columns, strict=True):
            column.append(row[i])
        lines.append(line)
    read = dict(zip(kept, columns, strict=True))
    cells = tuple(read.get(i) for i in range(len(names)))
    form = f"text, {layout.words}"
    return Table(source, names, cells, lines, decimal=layout.decimal, units=units, faults=faults, form=form)


def _names(source: str, found: tuple[list[str], int] | None) -> tuple[str, ...]:
    """Names of the columns."""
    if found is None:
        raise InputError(f"{source}: is empty; a header line and rows are needed")
    head, line = found
    if len(head) > MOST_COLUMNS:
        raise InputError(f"{source}: line {line}: has {len(head):,} columns; needs {MOST_COLUMNS:,} at most")
    if re.match(r"\s*(\{|\[\s*[\[{\"0-9-])", head[0]):
        raise InputError(f"{source}: line {line}: looks like JSON; a CSV or Parquet file is needed")
    if all(map(is_value, head)):
        raise InputError(
            f"{source}: line {line}: holds numbers; the first line must be the header with the column names"
        )
    return tuple(cell if cell.strip() else f"(unnamed {i + 1})" for i, cell in enumerate(head))


_NANOSECONDS = re.compile(r"(?P<stem>.*?)(?:nanosecs?|nsecs?|ns)")
_SECONDS = ("sec", "secs", "s")
_AND = " + "


def whole_stamps(names: Collection[str]) -> dict[str, tuple[str, str]]:
    """Columns of seconds and of nanoseconds by the name of their sum, `stamp.sec + stamp.nanosec`."""
    found = {}
    for name in names:
        match = _NANOSECONDS.fullmatch(name)
        for seconds in (match["stem"] + form for form in _SECONDS) if match else ():
            if seconds in names:
                found[f"{seconds}{_AND}{name}"] = seconds, name
    return found


def _whole(seconds: Cells | None, nanoseconds: Cells | None) -> Cells | None:
    """Texts of both, the digits side by side; None where they were not read."""
    if seconds is None or nanoseconds is None:
        return None
    return [_stamp(str(a).strip(), str(b).strip()) for a, b in zip(seconds, nanoseconds, strict=True)]


def _stamp(seconds: str, nanoseconds: str) -> str:
    whole, parts = seconds.removesuffix(".0"), nanoseconds.removesuffix(".0")
    if whole.isdecimal() and parts.isdecimal() and len(parts) <= 9:
        return f"{whole}.{parts:0>9}"
    return f"{seconds}{_AND}{nanoseconds}"


_INDEX = "__index_level_0__"  # pandas' own name for an index without one


class DataFrame(Protocol):
    """A frame with Arrow's PyCapsule interface: pandas from 2.2, Polars from 1.3, pyarrow, DuckDB."""

    def __arrow_c_stream__(self, requested_schema: object | None = None) -> object: ...


def is_dataframe(given: object) -> bool:
    """Whether it speaks Arrow's protocol."""
    return not isinstance(given, type) and hasattr(given, "__arrow_c_stream__")


def frame_table(frame: DataFrame, source: str = "DataFrame") -> Table:
    """The columns of a data frame, cells not yet parsed as numbers; `source` names it in messages.

    An index with a name is a column of that name. An index of times without a name is the column ``time`` where there
    is none. Times become seconds since their epoch. Columns that hold neither numbers nor texts are not read.

    Raises InputError where the frame cannot be turned into Arrow columns.
    """
    import pyarrow as pa

    from avtorch.io.formats import parquet

    try:
        table: Any = pa.table(frame)
    except (pa.ArrowException, TypeError, ValueError, RuntimeError, NotImplementedError) as fault:
        raise InputError(f"{source}: no columns of numbers can be read from it ({reason(fault)})") from None
    names = [str(name) for name in table.column_names]
    if _INDEX in names and "time" not in names and parquet.is_time(table.column(names.index(_INDEX)).type):
        names[names.index(_INDEX)] = "time"
    kept = [i for i in range(len(names)) if parquet.readable(table.column(i).type)]
    cells = tuple(parquet.cells_of(table.column(i), f"{source}: column {quoted(names[i])}") for i in kept)
    return Table(source, tuple(names[i] for i in kept), cells, form=f"a {type(frame).__name__}")
