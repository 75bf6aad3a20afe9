"""Locks on folders between processes; the system releases them however a process ends."""

from __future__ import annotations

import errno
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from avtorch.errors import InputError

try:
    import fcntl
except ImportError:  # Windows has no locks on folders
    fcntl = None

_PATIENCE_S = 10.0


@contextmanager
def lock_if_free(folder: Path) -> Iterator[bool]:
    """Try to hold the lock of `folder` within the block; yields whether it is held.

    False too where the system has no such locks: a folder not known to be free counts as used.
    """
    with _opened(folder) as handle:
        yield _acquire(handle) is True


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Hold the lock of `folder` within the block, waiting for it some seconds; no lock where the system has none.

    Raises InputError where another process keeps it.
    """
    with _opened(folder) as handle:
        until = time.monotonic() + _PATIENCE_S
        while _acquire(handle) is False:
            if time.monotonic() > until:
                raise InputError(f"{folder.parent}: another process is writing an answer there; needs it to end first")
            time.sleep(0.02)
        yield


@contextmanager
def _opened(folder: Path) -> Iterator[int | None]:
    if fcntl is None:
        yield None
        return
    handle = os.open(folder, os.O_RDONLY)
    try:
        yield handle
    finally:
        os.close(handle)


def _acquire(handle: int | None) -> bool | None:
    """True: held; False: another process holds it; None: there are no such locks here."""
    if fcntl is None or handle is None:
        return None
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as fault:
        return False if fault.errno in (errno.EAGAIN, errno.EACCES) else None
    return True
