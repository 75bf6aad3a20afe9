"""What a file of rows says of itself: what they were computed from, for which log, and how that ended."""

from __future__ import annotations

import os

KEY, LABEL, STATUS = b"avtorch.key", b"avtorch.label", b"avtorch.status"


def marks_of(path: str | os.PathLike[str]) -> dict[bytes, bytes]:
    """The marks of a Parquet file; none where it is missing, damaged, or not of a fleet."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        return pq.read_schema(path).metadata or {}
    except (OSError, ValueError, pa.ArrowException):
        return {}


def is_rows(path: str | os.PathLike[str]) -> bool:
    """Whether a Parquet file holds rows of a fleet, and no log."""
    return KEY in marks_of(path)
