"""State files that are accepted only if intact: a checksum, a schema, and the identity of what the content belongs to.

A sealed file is JSON. Its first line holds the schema and the SHA-256 of everything else, so that the checksum is
compared before anything is parsed:

    {"schema": "avtorch.fits/3", "sha256": "9f…",
     "of": {…},
     "content": {…}
    }

With bytes as content, they follow after the second line. The checksum detects damage and careless edits; it is not a
signature, and the reader of a file must still check the shape of its content.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import stat
import struct
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

import numpy as np

from avtorch.errors import InputError
from avtorch.io.answers import atomic, json_text
from avtorch.io.opening import TooLarge, kind_of, read_regular


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

_FIRST = re.compile(rb'\{"schema": "([a-z0-9_./-]{1,80})", "sha256": "([0-9a-f]{64})",')


class Damaged(InputError):
    """Raised for a regular file whose content is damaged; the caller may compute it again."""


class Sealed(NamedTuple):
    """What a file belongs to (`of`), and its `content`: from JSON, or bytes."""

    of: dict[str, Any]
    content: Any


def write_sealed(path: Path, content: Any, *, schema: str, of: Mapping[str, Any]) -> None:
    """Write `content` (bytes, or what `json_text` accepts) so that `path` is complete or unchanged.

    `of`: what it belongs to. Raises `InputError` where `path` cannot be written, or is a symlink, a folder, a device.
    """
    _free_or_regular(path)
    if isinstance(content, bytes):
        line = json_text({"of": of, "bytes": len(content)}, indent=None, ascii_only=True)
        rest = line[1:].encode() + b"\n" + content
    else:
        # a file's name may contain bytes that are not UTF-8
        rest = json_text({"of": of, "content": content}, ascii_only=True)[1:].lstrip().encode() + b"\n"
    first = f'{{"schema": "{schema}", "sha256": "{_checksum(schema.encode(), rest)}",\n'
    with atomic(path, binary=True) as stream:
        stream.write(first.encode() + rest)


def read_sealed(path: Path, *, schema: str, most: int = MOST, remedy: str = REMEDY) -> Sealed:
    """Read what `write_sealed` wrote from JSON content.

    `most`: bytes, above which the file is not read. `remedy`: advice to the user, the end of every message. Raises
    `InputError` for what is no regular file, `Damaged` for anything but a file of this `schema` as it was written.
    """
    found = _parsed(b"{" + _verified(path, schema, most, remedy), path, schema, "content", remedy)
    return Sealed(found["of"], found["content"])


def read_sealed_bytes(path: Path, *, schema: str, most: int = MOST, remedy: str = REMEDY) -> Sealed:
    """The same of a file with bytes as its content."""
    line, _, content = _verified(path, schema, most, remedy).partition(b"\n")
    found = _parsed(b"{" + line, path, schema, "bytes", remedy)
    if found["bytes"] != len(content):
        _refuse(path, f"holds {len(content)} bytes, not the {str(found['bytes'])[:20]} it names", remedy)
    return Sealed(found["of"], content)


def _verified(path: Path, schema: str, most: int, remedy: str) -> bytes:
    """What follows the first line, once the checksum is found right."""
    try:
        raw = read_regular(path, most=most, need="a regular file", links=False)
    except TooLarge:
        _refuse(path, f"is larger than {most / 2**20:.0f} MiB, which no file of its kind is", remedy)
    except InputError as fault:
        raise InputError(f"{fault}; {remedy}") from None
    first, newline, rest = raw.partition(b"\n")
    match = _FIRST.fullmatch(first)
    if not match or not newline:
        _refuse(path, "is damaged, or from an earlier avtorch that wrote no checksum", remedy)
    if _checksum(match[1], rest) != match[2].decode():
        _refuse(path, "is damaged or was changed by hand: its checksum is not that of its content", remedy)
    if match[1].decode() != schema:
        _refuse(path, f"holds {match[1].decode()}, needs {schema}", remedy)
    return rest


def _checksum(schema: bytes, rest: bytes) -> str:
    return hashlib.sha256(schema + b"\n" + rest).hexdigest()


def _parsed(text: bytes, path: Path, schema: str, key: str, remedy: str) -> dict[str, Any]:
    try:
        found = json.loads(text, parse_constant=_no_number)
    except (ValueError, RecursionError):
        _refuse(path, "holds no JSON of finite numbers", remedy)
    if not isinstance(found, dict) or set(found) != {"of", key} or not isinstance(found["of"], dict):
        _refuse(path, f"is no {schema} inside", remedy)
    return found


def _no_number(text: str) -> NoReturn:
    raise ValueError(text)


def _free_or_regular(path: Path) -> None:
    try:
        kind = os.lstat(path).st_mode
    except (OSError, ValueError):
        return  # no file yet; the writer reports any other fault
    if not stat.S_ISREG(kind):
        raise InputError(f"{path}: is {kind_of(kind)}; a regular file or a free name is needed")


def _refuse(path: Path, what: str, remedy: str) -> NoReturn:
    raise Damaged(f"{path}: {what}; {remedy}")
