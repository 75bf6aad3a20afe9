"""Cells of Arrow columns, of a Parquet file or of a data frame, as tables hold them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from avtorch.errors import InputError

_TEXT = 100  # bytes of the longest text that can be a number

Cells = Sequence[Any] | NDArray


def scalar_checks() -> Iterator[Callable[[Any], bool]]:
    """Tests of an Arrow type, one of which a column of numbers or times passes."""
    from pyarrow import types

    yield from (types.is_integer, types.is_floating, types.is_boolean, types.is_decimal, types.is_null)
    yield from (types.is_timestamp, types.is_duration)


def cells_of(column: Any, where: str) -> Cells:
    """The cells of one batch of a column."""
    import pyarrow as pa
    import pyarrow.compute as pc

    if pa.types.is_dictionary(column.type):
        if pa.types.is_string(column.type.value_type) or pa.types.is_large_string(column.type.value_type):
            lengths = pc.binary_length(column.dictionary)  # pyright: ignore[reportAttributeAccessIssue]
            longest = max((n or 0 for n in lengths.to_pylist()), default=0)
            if longest > _TEXT:
                raise InputError(f"{where}: holds texts of {longest:,} bytes; numbers are needed")
        column = column.dictionary_decode()
    kind = column.type
    if pa.types.is_timestamp(kind) or pa.types.is_duration(kind):
        return _seconds(column)
    if column.null_count == 0 and (pa.types.is_integer(kind) or pa.types.is_floating(kind)):
        return np.asarray(column.to_numpy(zero_copy_only=False), dtype=np.float64)
    # text, booleans, decimals and empty cells go through the same careful reading as a CSV
    return column.to_pylist()


def joined(pieces: list[Cells]) -> Cells:
    """The batches of one column behind one another."""
    arrays = [piece for piece in pieces if isinstance(piece, np.ndarray)]
    if len(arrays) == len(pieces):
        return np.concatenate(arrays) if arrays else np.empty(0)
    return [cell for piece in pieces for cell in piece]


def _seconds(column: Any) -> Sequence[Any]:
    """A time stamp of Arrow brings its own unit: seconds since its epoch, the same for every column of the table."""
    import pyarrow as pa

    ticks = {"s": 1, "ms": 10**3, "us": 10**6, "ns": 10**9}[column.type.unit]
    return [None if x is None else x / ticks for x in column.cast(pa.int64()).to_pylist()]
