"""Parquet files from outside: only the columns that are asked for, in batches, within what their metadata may claim."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Sequence
from itertools import accumulate
from typing import Any

from avtorch.errors import InputError, printable, quoted
from avtorch.io.arrow_cells import Cells, cells_of, joined, scalar_checks
from avtorch.io.parquet_footer import uncompressed_sizes
from avtorch.io.size import MOST_CELLS, MOST_COLUMNS

_BATCH = 65536  # rows decoded at once
_CELL_BYTES, _PAGE_BYTES = 64, 2**22  # bytes per uncompressed cell, and per column besides


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
        elif not any(check(kind) for check in scalar_checks()):
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
            pieces[i].append(cells_of(column, f"{source}: column {quoted(names[i])}"))
        rows += batch.num_rows
    if kept and rows != metadata.num_rows:
        raise InputError(f"{source}: damaged Parquet file ({rows} rows where it declares {metadata.num_rows})")
    return names, tuple(joined(pieces[i]) if i in pieces else None for i in range(len(names)))


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
