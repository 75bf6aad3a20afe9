"""Cells of Arrow columns, of a Parquet file or of a data frame, as tables hold them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from avtorch.errors import InputError

MOST_TEXT = 100
"""Bytes of the longest text that can be a number."""

Cells = Sequence[Any] | NDArray


def is_text(kind: Any) -> bool:
    """Whether an Arrow type is of text."""
    from pyarrow import types

    views = filter(None, (getattr(types, "is_string_view", None),))
    return any(check(kind) for check in (types.is_string, types.is_large_string, *views))


def scalar_checks() -> tuple[Callable[[Any], bool], ...]:
    """Tests of an Arrow type, one of which a column of numbers or times passes."""
    from pyarrow import types

    numbers = types.is_integer, types.is_floating, types.is_boolean, types.is_decimal, types.is_null
    return *numbers, types.is_timestamp, types.is_duration


def cells_of(column: Any, where: str) -> Cells:
    """The cells of a column; a time stamp brings its own unit and becomes seconds since its epoch."""
    import pyarrow as pa
    import pyarrow.compute as pc

    column = column.combine_chunks()
    if isinstance(column, pa.ChunkedArray):  # of several chunks that do not fit into one
        column = pa.concat_arrays(column.chunks)
    if pa.types.is_dictionary(column.type):
        if is_text(column.type.value_type):
            lengths = pc.binary_length(column.dictionary)  # pyright: ignore[reportAttributeAccessIssue]
            longest = max((n or 0 for n in lengths.to_pylist()), default=0)
            if longest > MOST_TEXT:
                raise InputError(f"{where}: holds texts of {longest:,} bytes; numbers are needed")
        column = column.dictionary_decode()
    kind = column.type
    if pa.types.is_timestamp(kind) or pa.types.is_duration(kind):
        ticks = {"s": 1, "ms": 10**3, "us": 10**6, "ns": 10**9}[kind.unit]
        return [None if x is None else x / ticks for x in column.cast(pa.int64()).to_pylist()]
    if column.null_count == 0 and (pa.types.is_integer(kind) or pa.types.is_floating(kind)):
        return np.asarray(column.to_numpy(zero_copy_only=False), dtype=np.float64)
    # text, booleans, decimals and empty cells go through the same careful reading as a CSV
    return column.to_pylist()
