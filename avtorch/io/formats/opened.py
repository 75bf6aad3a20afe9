"""A file that a library reads: opened here, once, as a regular file, so that it cannot be a pipe that never ends."""

from __future__ import annotations

import io
import os
import stat
from typing import BinaryIO

from avtorch.errors import InputError, printable
from avtorch.io.opening import TooLarge, kind_of, place, read_regular


def opened(path: str | os.PathLike[str], *, need: str) -> BinaryIO:
    """A regular file, open for reading bytes; the caller closes it. `need` names the expected file in messages.

    Opening never waits: a pipe, a device or a directory is refused. Raises InputError.
    """
    shown = place(path)
    flags = os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_CLOEXEC", 0) | getattr(os, "O_BINARY", 0)
    try:
        handle = os.open(path, flags)
    except FileNotFoundError:
        raise InputError(f"{shown}: no such file") from None
    except (OSError, ValueError) as fault:
        why = fault.strerror if isinstance(fault, OSError) else printable(str(fault), 80)
        raise InputError(f"{shown}: cannot be read ({why}); {need} is needed") from None
    try:
        mode = os.fstat(handle).st_mode
        if not stat.S_ISREG(mode):
            raise InputError(f"{shown}: is {kind_of(mode)}; {need} is needed")
        return os.fdopen(handle, "rb")
    except BaseException:
        os.close(handle)
        raise


def beginning(path: str | os.PathLike[str], count: int, *, need: str) -> bytes:
    """The first `count` bytes of a regular file, fewer where it is shorter. Raises InputError."""
    with opened(path, need=need) as stream:
        return stream.read(count)


def in_memory(path: str | os.PathLike[str], *, most: int, need: str) -> io.BytesIO:
    """A regular file of up to `most` bytes, read at once. Raises InputError."""
    try:
        return io.BytesIO(read_regular(path, most=most, need=need))
    except TooLarge as fault:
        raise InputError(f"{fault}: split it") from None
