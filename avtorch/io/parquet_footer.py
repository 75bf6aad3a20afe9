"""The column sizes that a Parquet file declares, read from its footer in Python.

pyarrow's own `RowGroupMetaData.column` lets C++ exceptions through, which end the process: a damaged file must not get
that far. The footer is a Thrift struct in the compact protocol (https://github.com/apache/thrift/blob/master/doc/specs/
thrift-compact-protocol.md), its fields those of parquet.thrift (https://github.com/apache/parquet-format).
"""

from __future__ import annotations

import struct
from typing import Any

_ROW_GROUPS, _COLUMNS, _META_DATA, _UNCOMPRESSED = 4, 1, 3, 6
"""Fields of FileMetaData, RowGroup, ColumnChunk and ColumnMetaData."""

_DEEPEST = 16


def uncompressed_sizes(raw: bytes) -> list[list[int]]:
    """Bytes that each column of each row group takes uncompressed, as the file claims.

    Raises ValueError for a footer that is damaged, or encrypted.
    """
    (length,) = struct.unpack("<I", raw[-8:-4])
    begin = len(raw) - 8 - length
    if raw[-4:] != b"PAR1" or begin < 4:
        raise ValueError("no footer of the length that it names")
    groups = _Footer(raw[begin:-8]).struct().get(_ROW_GROUPS, [])
    try:
        sizes = [[chunk[_META_DATA][_UNCOMPRESSED] for chunk in group[_COLUMNS]] for group in groups]
    except (LookupError, TypeError):  # damaged: a list for a struct, or a number for a list
        raise ValueError("a row group does not declare the size of its columns") from None
    if not all(type(size) is int for group in sizes for size in group):
        raise ValueError("a row group does not declare the size of its columns")
    return sizes


class _Footer:
    """A reader of the compact protocol; a struct comes as {field: value}, texts as None."""

    def __init__(self, raw: bytes) -> None:
        self._raw, self._at = raw, 0

    def struct(self, depth: int = 0) -> dict[int, Any]:
        if depth > _DEEPEST:
            raise ValueError("its footer is nested too deeply")
        found: dict[int, Any] = {}
        field = 0
        while head := self._byte():
            field = field + (head >> 4) if head >> 4 else self._signed()
            found[field] = self._value(head & 15, depth)
        return found

    def _value(self, kind: int, depth: int) -> Any:
        match kind:
            case 1 | 2:  # a boolean field's value is its type code
                return kind == 1
            case 3:
                return self._byte()
            case 4 | 5 | 6:
                return self._signed()
            case 7:
                return self._skip(8)
            case 8:
                return self._skip(self._unsigned())
            case 9 | 10:
                head = self._byte()
                count = head >> 4 if head >> 4 < 15 else self._unsigned()
                self._left(count)  # each element takes at least one byte
                inner = head & 15
                # in a list a boolean takes a byte of its own
                return [self._byte() if inner in (1, 2) else self._value(inner, depth + 1) for _ in range(count)]
            case 12:
                return self.struct(depth + 1)
        raise ValueError(f"its footer has a field of kind {kind}")

    def _byte(self) -> int:
        self._left(1)
        self._at += 1
        return self._raw[self._at - 1]

    def _unsigned(self) -> int:
        value = 0
        for shift in range(0, 70, 7):
            byte = self._byte()
            value |= (byte & 127) << shift
            if byte < 128:
                return value
        raise ValueError("its footer has a number of more than 64 bits")

    def _signed(self) -> int:
        value = self._unsigned()
        return (value >> 1) ^ -(value & 1)

    def _skip(self, count: int) -> None:
        self._left(count)
        self._at += count

    def _left(self, count: int) -> None:
        if count > len(self._raw) - self._at:
            raise ValueError("its footer ends too early")
