"""Data frames of other libraries as tables, by Arrow's protocol, which pandas, Polars, pyarrow and DuckDB speak."""

from __future__ import annotations

from typing import Any, Protocol

from avtorch.errors import InputError, printable, quoted
from avtorch.io.formats.parquet import cells_of, is_text, scalar_checks
from avtorch.io.tables import Table

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

    try:
        table: Any = pa.table(frame)
    except (pa.ArrowException, TypeError, ValueError, RuntimeError, NotImplementedError) as fault:
        reason = str(fault).splitlines()[0] if str(fault) else type(fault).__name__
        raise InputError(f"{source}: no columns of numbers can be read from it ({printable(reason, 120)})") from None
    names = [str(name) for name in table.column_names]
    if _INDEX in names and "time" not in names and _is_time(table.column(names.index(_INDEX)).type):
        names[names.index(_INDEX)] = "time"
    kept = [i for i in range(len(names)) if _readable(table.column(i).type)]
    cells = tuple(cells_of(table.column(i), f"{source}: column {quoted(names[i])}") for i in kept)
    return Table(source, tuple(names[i] for i in kept), cells, form=f"a {type(frame).__name__}")


def _is_time(kind: Any) -> bool:
    from pyarrow import types

    return types.is_timestamp(kind) or types.is_duration(kind)


def _readable(kind: Any) -> bool:
    from pyarrow import types

    if types.is_dictionary(kind):
        kind = kind.value_type
    return is_text(kind) or any(check(kind) for check in scalar_checks())
