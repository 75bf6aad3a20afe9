"""State files that are accepted only if intact: a checksum, a schema, and the identity of what the content belongs to.

The first line of a sealed file is the SHA-256 of everything else, the second one JSON, the schema and what the content
belongs to; the content follows. The checksum is compared before anything is parsed. It detects damage and careless
edits; it is not a signature, and the reader of a file must still check the shape of its content.
"""

from __future__ import annotations

import hashlib
import json
import struct
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from avtorch.errors import InputError
from avtorch.io.answers import atomic, json_text
from avtorch.io.opening import TooLarge, read_regular


def fingerprint(*parts: Any) -> str:
    """64 hex digits over `parts`: arrays and tensors by dtype, shape and bytes, dataclasses by class and fields.

    Takes None, booleans, numbers, strings, bytes, classes, slices, arrays, and mappings, sequences and dataclasses of
    these. Raises TypeError for anything else: omitting a value would give two different objects the same fingerprint.
    """
    state = hashlib.sha256()
    _feed(state, parts)
    return state.hexdigest()


def _feed(state: Any, x: Any) -> None:
    # every value is preceded by its kind and length, so that no two sequences of values share their bytes
    if x is None or isinstance(x, (bool, int, str)):
        _tagged(state, type(x).__name__, repr(x).encode("utf-8", "backslashreplace"))
    elif isinstance(x, float):
        _tagged(state, "float", struct.pack("<d", x))
    elif isinstance(x, bytes):
        _tagged(state, "bytes", x)
    elif isinstance(x, type):
        _tagged(state, "type", f"{x.__module__}.{x.__qualname__}".encode())
    elif is_dataclass(x):
        _feed(state, type(x))
        for field in fields(x):
            _feed(state, field.name)
            _feed(state, getattr(x, field.name))
    elif isinstance(x, Mapping):
        _tagged(state, "mapping", str(len(x)).encode())
        for key in sorted(x):
            _feed(state, key)
            _feed(state, x[key])
    elif isinstance(x, slice):
        _tagged(state, "slice", repr((x.start, x.stop, x.step)).encode())
    elif isinstance(x, (list, tuple)):
        _tagged(state, "sequence", str(len(x)).encode())
        for value in x:
            _feed(state, value)
    elif hasattr(x, "__array__"):
        array = np.asarray(x)
        if array.dtype.hasobject:
            raise TypeError("an array of objects has no bytes of its own")
        _tagged(state, f"array {array.dtype.str} {array.shape}", array.tobytes())
    else:
        raise TypeError(f"a {type(x).__name__} has no fingerprint")


def _tagged(state: Any, kind: str, content: bytes) -> None:
    state.update(f"{kind}:{len(content)}:".encode())
    state.update(content)


MOST = 64 * 2**20
"""Maximum size of a state file [bytes], unless its reader sets another."""

REMEDY = "remove it, or use another folder"


class Damaged(InputError):
    """Raised for a regular file whose content is damaged; the caller may compute it again."""


class Sealed(NamedTuple):
    """What a file belongs to (`of`), and its `content`."""

    of: dict[str, Any]
    content: bytes


def write_sealed(path: Path, content: bytes, *, schema: str, of: Mapping[str, Any]) -> None:
    """Write `content` so that `path` is complete or unchanged.

    `of`: what it belongs to. Raises `InputError` where `path` cannot be written.
    """
    # a file's name may contain bytes that are not UTF-8
    rest = json_text({"schema": schema, "of": of}, indent=None, ascii_only=True).encode() + b"\n" + content
    with atomic(path, binary=True) as stream:
        stream.write(hashlib.sha256(rest).hexdigest().encode() + b"\n" + rest)


def read_sealed_bytes(path: Path, *, schema: str, most: int = MOST, remedy: str = REMEDY) -> Sealed:
    """Read what `write_sealed` wrote.

    `most`: bytes, above which the file is not read. `remedy`: advice to the user, the end of every message. Raises
    `InputError` for what is no regular file, `Damaged` for anything but a file of this `schema` as it was written.
    """
    try:
        raw = read_regular(path, most=most, need="a regular file", links=False)
    except TooLarge:
        raise Damaged(
            f"{path}: is larger than {most / 2**20:.0f} MiB, which no file of its kind is; {remedy}"
        ) from None
    except InputError as fault:
        raise InputError(f"{fault}; {remedy}") from None
    first, _, rest = raw.partition(b"\n")
    if first != hashlib.sha256(rest).hexdigest().encode():
        raise Damaged(f"{path}: is damaged, changed by hand or of an earlier avtorch: its checksum is wrong; {remedy}")
    line, _, content = rest.partition(b"\n")
    try:
        head = json.loads(line)
    except (ValueError, RecursionError):
        head = None
    if not isinstance(head, dict) or set(head) != {"schema", "of"} or not isinstance(head["of"], dict):
        raise Damaged(f"{path}: is no {schema} inside; {remedy}")
    if head["schema"] != schema:
        raise Damaged(f"{path}: holds {str(head['schema'])[:80]}, needs {schema}; {remedy}")
    return Sealed(head["of"], content)
