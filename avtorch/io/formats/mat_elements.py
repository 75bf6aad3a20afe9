"""The elements of a MAT file of version 5, walked before SciPy reads them: how deep and how large they are.

An element is a tag of type and size with its content. A matrix is an element of elements; a struct or a cell holds
matrices again. Compressed elements are inflated here up to a limit: a few bytes may hold gigabytes, and a chain of
matrices within each other would end the process, not the reading.
"""

from __future__ import annotations

import struct
import zlib

from avtorch.errors import InputError
from avtorch.io.size import MOST_CELLS

_MATRIX, _COMPRESSED = 14, 15
_NESTED_CLASSES = frozenset((1, 2, 3, 16, 17))  # cell, struct, object, function, opaque
_DEEPEST = 32
_MOST_MATRICES = 1_000_000
_MOST_BYTES = 16 * MOST_CELLS  # inflated


def check_elements(raw: bytes, source: str) -> bool:
    """Walk the elements behind the header; whether the file is cut off within its last one.

    Raises InputError beyond 32 matrices within each other, a million in all, or 320 million bytes inflated.
    """
    return _Walk(raw, source).run()


class _Walk:
    def __init__(self, raw: bytes, source: str) -> None:
        self.raw, self.source = raw, source
        self.order = ">" if raw[126:128] == b"MI" else "<"
        self.matrices = self.inflated = 0

    def run(self) -> bool:
        at = 128
        while at + 8 <= len(self.raw):
            type_, size = struct.unpack_from(f"{self.order}II", self.raw, at)
            if at + 8 + size > len(self.raw):
                return True
            if type_ == _COMPRESSED:
                data = self.inflate(self.raw[at + 8 : at + 8 + size], at)
                self.element(data, 0, len(data), 0)
            elif type_ == _MATRIX:
                self.element(self.raw, at, at + 8 + size, 0)
            at += 8 + size
        return at != len(self.raw)

    def inflate(self, data: bytes, at: int) -> bytes:
        most = _MOST_BYTES - self.inflated
        try:
            inflating = zlib.decompressobj()
            found = inflating.decompress(data, most)
        except zlib.error as fault:
            raise InputError(
                f"{self.source}: byte {at:,}: cannot be inflated ({fault}); an undamaged MAT file is needed"
            ) from None
        if inflating.unconsumed_tail:
            raise InputError(f"{self.source}: inflates to more than {_MOST_BYTES:,} bytes; split it")
        self.inflated += len(found)
        return found

    def tag(self, data: bytes, at: int, end: int) -> tuple[int, int, int, int] | None:
        """Type, where the content begins and ends, and where the next tag is; None where no tag fits."""
        if at + 8 > end:
            return None
        type_, size = struct.unpack_from(f"{self.order}II", data, at)
        if type_ >> 16:  # a small element: its size is in the upper half, its content in the tag
            return type_ & 0xFFFF, at + 4, at + 4 + (type_ >> 16), at + 8
        return type_, at + 8, at + 8 + size, at + 8 + (size + 7) // 8 * 8

    def element(self, data: bytes, at: int, end: int, depth: int) -> None:
        """A matrix: flags, dimensions, name, then content, which are matrices again in a struct or a cell."""
        self.matrices += 1
        if depth > _DEEPEST:
            raise InputError(f"{self.source}: holds structs more than {_DEEPEST} deep; at most that is read")
        if self.matrices > _MOST_MATRICES:
            raise InputError(f"{self.source}: holds more than {_MOST_MATRICES:,} matrices; split it")
        outer = self.tag(data, at, end)
        if outer is None or outer[0] != _MATRIX:
            return
        at, end = outer[1], min(end, outer[2])
        flags = self.tag(data, at, end)
        if flags is None or flags[1] + 4 > end:
            return
        class_ = struct.unpack_from(f"{self.order}I", data, flags[1])[0] & 0xFF
        if class_ not in _NESTED_CLASSES:
            return
        while (tag := self.tag(data, at, end)) is not None:
            if tag[0] == _MATRIX:
                self.element(data, at, end, depth + 1)
            at = tag[3]
