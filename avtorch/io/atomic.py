"""Files that appear whole or not at all: written under a temporary name in the same folder, then renamed."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO

from avtorch.errors import InputError


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
        try:
            # newline="" keeps line ends as given, so that a log has the same bytes on every system
            opened = os.fdopen(handle, "wb") if binary else os.fdopen(handle, "w", encoding="utf-8", newline="")
        except BaseException:
            os.close(handle)
            raise
        with opened as stream:
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
