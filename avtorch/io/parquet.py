"""Parquet files from outside: only the columns that are asked for, in batches, within what their metadata may claim."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterator, Sequence
from itertools import accumulate
from typing import Any

import numpy as np
from numpy.typing import NDArray

from avtorch.errors import InputError, printable, quoted
from avtorch.io.parquet_footer import uncompressed_sizes
from avtorch.io.size import MOST_CELLS, MOST_COLUMNS

_BATCH = 65536  # rows decoded at once
_CELL_BYTES, _PAGE_BYTES = 64, 2**22  # bytes per uncompressed cell, and per column besides
_TEXT = 100  # bytes of the longest text that can be a number

Cells = Sequence[Any] | NDArray


def read_parquet(
    raw: bytes, source: str, wanted: Callable[[tuple[str, ...]], Collection[str]] | None
) -> tuple[tuple[str, ...], tuple[Cells | None, ...]]:
    """Names of all columns, and the cells of the `wanted` ones (default: all), None for the others.

    Time stamps become seconds since their epoch. The schema and the metadata are read first: a file that claims more
    than 20 million cells in the wanted columns, or more than 64 bytes for each of them, is refused before anything is
    decoded, and so are nested columns and texts that are too long for a number. Raises InputError.
    """
    import pyarrow as pa

    try:
        return _read(raw, source, wanted)
    except InputError:
        raise
    except (pa.ArrowException, OSError, ValueError, KeyError, TypeError, OverflowError, MemoryError, RuntimeError) as e:
        reason = str(e).splitlines()[0] if str(e) else type(e).__name__
        raise InputError(f"{source}: damaged Parquet file ({printable(reason, 120)})") from None


def _read(
    raw: bytes, source: str, wanted: Callable[[tuple[str, ...]], Collection[str]] | None
) -> tuple[tuple[str, ...], tuple[Cells | None, ...]]:
    import pyarrow as pa
    import pyarrow.parquet as pq

    buffer = pa.BufferReader(raw)
    metadata = pq.read_metadata(buffer)
    if metadata.num_columns > MOST_COLUMNS:
        raise InputError(f"{source}: has {metadata.num_columns:,} columns; needs {MOST_COLUMNS:,} at most")
    schema = metadata.schema.to_arrow_schema()
    names = tuple(schema.names)
    chosen, count = set(names if wanted is None else wanted(names)), Counter(names)
    # the caller refuses a name that occurs twice
    kept = [i for i, name in enumerate(names) if name in chosen and count[name] == 1]
    _refuse_size(raw, metadata, source, [names[i] for i in kept])
    texts = []
    for i in kept:
        kind = schema.field(i).type
        if pa.types.is_dictionary(kind):
            kind = kind.value_type
        if pa.types.is_string(kind) or pa.types.is_large_string(kind):
            texts.append(names[i])
        elif not any(check(kind) for check in _scalar_checks()):
            what = printable(str(kind), 40)
            raise InputError(f"{source}: column {quoted(names[i])}: holds {what}; numbers are needed")
    file = pq.ParquetFile(pa.BufferReader(raw), read_dictionary=texts, metadata=metadata)
    pieces: dict[int, list[Cells]] = {i: [] for i in kept}
    rows = 0
    for batch in file.iter_batches(batch_size=_BATCH, columns=[names[i] for i in kept], use_threads=False):
        if rows + batch.num_rows > metadata.num_rows:
            raise InputError(f"{source}: damaged Parquet file (more rows than the {metadata.num_rows} it declares)")
        for i in kept:
            column = batch.column(batch.schema.get_field_index(names[i]))
            pieces[i].append(_cells(column, f"{source}: column {quoted(names[i])}"))
        rows += batch.num_rows
    if kept and rows != metadata.num_rows:
        raise InputError(f"{source}: damaged Parquet file ({rows} rows where it declares {metadata.num_rows})")
    return names, tuple(_joined(pieces[i]) if i in pieces else None for i in range(len(names)))


def _scalar_checks() -> Iterator[Callable[[Any], bool]]:
    from pyarrow import types

    yield from (types.is_integer, types.is_floating, types.is_boolean, types.is_decimal, types.is_null)
    yield from (types.is_timestamp, types.is_duration)


def _refuse_size(raw: bytes, metadata: Any, source: str, kept: Sequence[str]) -> None:
    if metadata.num_rows * max(1, len(kept)) > MOST_CELLS:
        raise InputError(
            f"{source}: has {metadata.num_rows:,} rows of {len(kept)} columns that are read; "
            f"needs {MOST_CELLS:,} cells at most"
        )
    sizes = uncompressed_sizes(raw)
    columns = metadata.num_columns
    # pyarrow would look up what is not there
    if len(sizes) != metadata.num_row_groups or any(len(group) != columns for group in sizes):
        raise ValueError(f"a row group does not have the {columns} columns of the file")
    # the library reads a column by the first part of its path
    paths = [metadata.schema.column(i).path for i in range(columns)]
    wanted = set(kept)
    read = [i for i, path in enumerate(paths) if not wanted.isdisjoint(accumulate(path.split("."), "{}.{}".format))]
    parts = [group[i] for group in sizes for i in read]
    claimed = -1 if any(size < 0 for size in parts) else sum(parts)
    most = (_CELL_BYTES * metadata.num_rows + _PAGE_BYTES) * max(1, len(kept))
    if not 0 <= claimed <= most:
        raise InputError(
            f"{source}: takes {claimed:,} bytes uncompressed for {metadata.num_rows:,} rows of {len(kept)} columns; "
            f"needs {most:,} at most"
        )


def _cells(column: Any, where: str) -> Cells:
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


def _joined(pieces: list[Cells]) -> Cells:
    arrays = [piece for piece in pieces if isinstance(piece, np.ndarray)]
    if len(arrays) == len(pieces):
        return np.concatenate(arrays) if arrays else np.empty(0)
    return [cell for piece in pieces for cell in piece]


def _seconds(column: Any) -> Sequence[Any]:
    """A Parquet time stamp brings its own unit: seconds since its epoch, the same for every column of the file."""
    import pyarrow as pa

    ticks = {"s": 1, "ms": 10**3, "us": 10**6, "ns": 10**9}[column.type.unit]
    return [None if x is None else x / ticks for x in column.cast(pa.int64()).to_pylist()]
