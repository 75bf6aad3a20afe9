"""Files that appear whole or not at all, and JSON answers for machines: strict JSON, finite numbers only."""

from __future__ import annotations

import json
import math
import os
import re
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any

from avtorch.errors import InputError, printable


@contextmanager
def atomic(path: str | os.PathLike[str], *, binary: bool = False) -> Iterator[IO]:
    """Open ``path`` for writing so that a reader gets the old file or the new one, never a part of it.

    Missing folders are made. If the block raises, the temporary file is removed and ``path`` is unchanged.
    Raises InputError where the place cannot be written.
    """
    target = Path(path)
    try:
        if target.is_dir():
            raise InputError(f"{target}: is a directory; the name of a file is needed")
        target.parent.mkdir(parents=True, exist_ok=True)
        # same folder, hence same file system: only there is the rename atomic
        handle, name = tempfile.mkstemp(prefix=f".{target.name}.", suffix=".part", dir=target.parent)
    except OSError as fault:
        raise InputError(f"{target}: cannot be written ({fault.strerror or fault})") from None
    try:
        # newline="" keeps line ends as given, so that a log has the same bytes on every system
        with os.fdopen(handle, "wb") if binary else os.fdopen(handle, "w", encoding="utf-8", newline="") as stream:
            yield stream
            stream.flush()
            os.fsync(stream.fileno())
        mask = os.umask(0)
        os.umask(mask)
        os.chmod(name, 0o666 & ~mask)  # mkstemp makes it private; an answer gets the permissions of any other file
        os.replace(name, target)
    except BaseException as fault:
        with suppress(OSError):  # report the first failure
            os.unlink(name)
        if isinstance(fault, OSError):
            raise InputError(f"{target}: cannot be written ({fault.strerror or fault})") from None
        raise


_NOT_PLAIN = re.compile(r"[^ -~\n]")


def write_json(path: str | os.PathLike[str], obj: Any) -> None:
    """Write ``obj`` as indented UTF-8 JSON, atomically.

    Accepts dicts with string keys, lists, tuples, strings, numbers, booleans and None, and objects with ``tolist``
    (NumPy arrays and scalars, tensors). Control characters and other invisible ones are escaped. Raises
    InputError, naming the key, for NaN, infinity or a foreign type; nothing is written then, and an earlier file stays.
    """
    text = json_text(obj)
    with atomic(path) as stream:
        stream.write(text + "\n")


def json_text(obj: Any, *, indent: int | None = 1, ascii_only: bool = False) -> str:
    """``obj`` as strict JSON; accepts and refuses the same objects as :func:`write_json`."""
    text = json.dumps(_plain(obj, "$"), indent=indent, ensure_ascii=ascii_only, allow_nan=False)
    # invisible characters occur only in strings, where JSON can escape them
    return _NOT_PLAIN.sub(lambda found: _seen(found[0]), text)


def _seen(c: str) -> str:
    if printable(c) == c:
        return c
    return f"\\u{ord(c):04x}" if ord(c) < 0x10000 else json.dumps(c)[1:-1]


def _plain(x: Any, where: str) -> Any:
    """``x`` as strict JSON can hold it; ``where`` is its place in the answer, for the message."""
    if x is None or isinstance(x, (bool, str)):
        return x
    if isinstance(x, int):
        return int(x)
    if isinstance(x, float):
        if not math.isfinite(x):
            raise InputError(f"{where}: is {x}; an answer holds finite numbers, or null where there is none")
        return float(x)
    if isinstance(x, Mapping):
        for key in x:
            if not isinstance(key, str):
                raise InputError(f"{where}: has the key {key!r}; the keys of an answer are strings")
        return {str(key): _plain(value, f"{where}.{key}") for key, value in x.items()}
    if isinstance(x, (list, tuple)):
        return [_plain(value, f"{where}[{i}]") for i, value in enumerate(x)]
    if hasattr(x, "tolist"):
        return _plain(x.tolist(), where)
    raise InputError(f"{where}: is a {type(x).__name__}; an answer holds objects, lists, strings, numbers and null")
