"""Parquet by pyarrow, the columns that are asked for, within what a log may hold; and the cells of Arrow columns."""

from __future__ import annotations

import io
import os
from collections import Counter
from collections.abc import Collection, Sequence
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from numpy.typing import NDArray
from pyarrow import types

from avtorch.errors import InputError, printable, quoted
from avtorch.io.formats.kinds import Kind, guarded
from avtorch.io.opening import MOST_BYTES, MOST_CELLS, MOST_COLUMNS, place, read_regular

_NEED = "an undamaged Parquet file"
MOST_TEXT = 100
"""Bytes of the longest text that can be a number."""


def is_text(kind: Any) -> bool:
    """Whether an Arrow type is of text."""
    views = filter(None, (getattr(types, "is_string_view", None),))
    return any(check(kind) for check in (types.is_string, types.is_large_string, *views))


def is_time(kind: Any) -> bool:
    """Whether an Arrow type is of dates with times or of spans."""
    return types.is_timestamp(kind) or types.is_duration(kind)


def readable(kind: Any) -> bool:
    """Whether a column of an Arrow type can hold numbers or times."""
    kind = kind.value_type if types.is_dictionary(kind) else kind
    numbers = types.is_integer, types.is_floating, types.is_boolean, types.is_decimal, types.is_null
    return is_text(kind) or is_time(kind) or any(check(kind) for check in numbers)


def short_texts(column: Any, where: str) -> Any:
    """A column without Arrow's dictionary. InputError where its texts are too long for numbers."""
    kind, texts = column.type, [column]
    if types.is_dictionary(kind):
        kind, texts = kind.value_type, [chunk.dictionary for chunk in column.chunks]
    for text in texts if is_text(kind) else ():
        longest = pc.max(pc.binary_length(text)).as_py() or 0  # pyright: ignore[reportAttributeAccessIssue]
        if longest > MOST_TEXT:
            raise InputError(f"{where}: holds texts of {longest:,} bytes; numbers are needed")
    return column.cast(kind)


def cells_of(column: Any, where: str) -> Sequence[Any] | NDArray:
    """The cells of a column; a time stamp brings its own unit and becomes seconds since its epoch."""
    if types.is_dictionary(column.type):
        column = short_texts(column, where)
    kind = column.type
    if is_time(kind):
        ticks = {"s": 1, "ms": 10**3, "us": 10**6, "ns": 10**9}[kind.unit]
        return [None if x is None else x / ticks for x in column.cast(pa.int64()).to_pylist()]
    if column.null_count == 0 and (types.is_integer(kind) or types.is_floating(kind)):
        return np.asarray(column.to_numpy(), dtype=np.float64)
    # text, booleans, decimals and empty cells go through the same careful reading as a CSV
    return column.to_pylist()


class ParquetFile:
    """An opened file with the `names` of all its columns."""

    def __init__(self, source: str, file: Any) -> None:
        self.source, self._file = source, file
        self.names: list[str] = file.schema_arrow.names
        groups = [file.metadata.row_group(i) for i in range(file.metadata.num_row_groups)]
        if any(group.num_columns != file.metadata.num_columns for group in groups):
            raise InputError(f"{source}: damaged Parquet file (a row group does not have the columns of the file)")

    def stream(self, wanted: Collection[str]) -> bytes:
        """The `wanted` columns, of names that occur once, in Arrow's format for streams.

        Raises InputError for more than 20 million cells, for columns that hold no numbers, times or short texts, and
        for damaged ones.
        """
        count, rows, schema = Counter(self.names), self._file.metadata.num_rows, self._file.schema_arrow
        kept = [name for name in self.names if name in wanted and count[name] == 1]
        if rows * max(1, len(kept)) > MOST_CELLS:
            raise InputError(
                f"{self.source}: has {rows:,} rows of {len(kept)} columns that are read; "
                f"needs {MOST_CELLS:,} cells at most"
            )
        for name in kept:
            if not readable(kind := schema.field(name).type):
                what = printable(str(kind), 40)
                raise InputError(f"{self.source}: column {quoted(name)}: holds {what}; numbers are needed")
        with guarded(self.source, _NEED):
            # a column is found by the first part of its path, so that one with a dot in its name comes along
            found = self._file.read(columns=kept, use_threads=False)
            if kept and found.num_rows != rows:
                raise ValueError(f"{found.num_rows} rows where it declares {rows}")
            place_of = found.schema.get_field_index
            texts = [short_texts(found.column(place_of(n)), f"{self.source}: column {quoted(n)}") for n in kept]
            table = pa.table(texts, names=kept)
            table.validate(full=True)
            out = io.BytesIO()
            with pa.ipc.new_stream(out, table.schema) as writer:
                writer.write_table(table)
            return out.getvalue()


def open_file(path: str | os.PathLike[str], kind: Kind) -> ParquetFile:
    """Open a Parquet file and read its schema. Raises InputError."""
    source = place(path)
    raw = read_regular(path, most=MOST_BYTES, need="a CSV or Parquet file")
    with guarded(source, _NEED):
        found = ParquetFile(source, pq.ParquetFile(pa.BufferReader(raw)))
    if len(found.names) > MOST_COLUMNS:
        raise InputError(f"{source}: has {len(found.names):,} columns; needs {MOST_COLUMNS:,} at most")
    return found
