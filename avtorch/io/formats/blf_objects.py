"""The objects of a BLF file, walked before a library reads them: how far the file is sound.

After its header the file is a chain of containers, each compressed by itself; inflated and joined they are a chain of
frames and events. An object says its own size. One that says 0 would hold a reader for ever, and a container may claim
to be small and inflate without end.
"""

from __future__ import annotations

import struct
import zlib

from avtorch.errors import InputError

_OBJECT = struct.Struct("<4sHHII")  # signature, size of the header, its version, size of the object, type
_CONTAINER = struct.Struct("<H6xI4x")  # compression, size inflated
_CONTAINER_TYPE = 10
_HEADER_SIZE = 4  # where the file's header says how long it is
_MOST_INFLATED = 2**26  # bytes of one container; writers make them of 128 KiB
_SMALLEST = _OBJECT.size


def sound_part(raw: bytes, source: str) -> tuple[int, str | None]:
    """Bytes of `raw` that can be read, and what is wrong behind them; None where all of it is sound.

    Raises InputError where not even the first container is.
    """
    if len(raw) < 144 or raw[:4] != b"LOGG":
        raise InputError(f"{source}: has {len(raw):,} bytes; the header of a BLF file takes 144")
    start = struct.unpack_from("<I", raw, _HEADER_SIZE)[0]
    if not 72 <= start <= len(raw):
        raise InputError(f"{source}: its header claims {start:,} bytes; 144 are needed")
    at, tail, walked = start, b"", 0
    while at < len(raw):
        fault, end, tail = _container(raw, at, tail)
        if fault is not None:
            if walked == 0:
                raise InputError(f"{source}: byte {at:,}: {fault}; an undamaged BLF file is needed")
            return at, f"byte {at:,}: {fault}"
        at, walked = end, walked + 1
    return len(raw), None


def _container(raw: bytes, at: int, tail: bytes) -> tuple[str | None, int, bytes]:
    """What is wrong with the container at `at`, where the next one begins, and the incomplete object at its end."""
    if at + _OBJECT.size > len(raw):
        return "the file is cut off", at, tail
    signature, _, _, size, type_ = _OBJECT.unpack_from(raw, at)
    if signature != b"LOBJ" or size < _SMALLEST:
        return "no object begins here", at, tail
    if at + size > len(raw):
        return "the file is cut off within a container", at, tail
    end = min(len(raw), at + size + size % 4)
    if type_ != _CONTAINER_TYPE:
        return None, end, tail
    if size < _OBJECT.size + _CONTAINER.size:
        return "a container is shorter than its head", at, tail
    method, _ = _CONTAINER.unpack_from(raw, at + _OBJECT.size)
    data = raw[at + _OBJECT.size + _CONTAINER.size : at + size]
    if method == 2:
        try:
            inflating = zlib.decompressobj()
            data = inflating.decompress(data, _MOST_INFLATED)
        except zlib.error:
            return "a container cannot be inflated", at, tail
        if inflating.unconsumed_tail:
            return f"a container inflates to more than {_MOST_INFLATED:,} bytes", at, tail
    elif method != 0:
        return None, end, tail
    fault, tail = _objects(tail + data)
    return fault, end, tail


def _objects(data: bytes) -> tuple[str | None, bytes]:
    """What is wrong with a chain of objects, and the incomplete one at its end."""
    at, end, unpack = 0, len(data), _OBJECT.unpack_from
    while at + 8 <= end:
        found = data.find(b"LOBJ", at, at + 8)
        if found < 0:
            return "no object begins where the one before it ends", b""
        if found + _OBJECT.size > end:
            break
        size = unpack(data, found)[3]
        if size < _SMALLEST:
            return f"an object claims {size} bytes", b""
        if found + size > end:
            if size > _MOST_INFLATED:
                return f"an object claims {size:,} bytes", b""
            return None, data[found:]
        at = found + size
    return None, data[at:]
