"""One process at a time in a folder: a lock that names who holds it, and that ends with its process."""

from __future__ import annotations

import json
import os
import socket
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from errno import EINVAL, ENOLCK, ENOSYS, EOPNOTSUPP
from pathlib import Path
from typing import Any

from avtorch.errors import InputError, printable
from avtorch.io.opening import read_regular

LOCK = ".avtorch.lock"
"""The locked file's name; it is removed with the lock, and one that a killed process left locks nothing."""

_WAIT_S = 0.5  # for a process that is just ending
_NO_LOCKS = {ENOSYS, ENOLCK, EOPNOTSUPP, EINVAL}


@contextmanager
def sole_use(folder: str | os.PathLike[str], *, work: str) -> Iterator[bool]:
    """Keep other processes out of `folder` while the block runs; yields whether the file system has locks.

    `work` describes the running task in the message to those processes. A missing folder is made, and removed again if
    it stays empty. A nested block of the same folder and thread is admitted. The lock is the kernel's (`filelock`): it
    ends with its process, however that ends.

    Raises `InputError` that names the other process (pid, host, command, since when), or gives the reason why the
    folder cannot be written.
    """
    place = Path(folder)
    made = _make(place)
    lock = None
    try:
        lock = _acquired(place)
        if lock is not None and lock.lock_counter == 1:
            _sign(place / LOCK, work)
        yield lock is not None
    finally:
        if lock is not None:
            if lock.lock_counter == 1:
                # unlock only afterwards: filelock lets a process that waits on the removed file start again
                with suppress(OSError):
                    (place / LOCK).unlink()
            lock.release()
        for each in made:
            with suppress(OSError):  # not empty
                each.rmdir()


def _make(place: Path) -> list[Path]:
    """Make the folder; returns what was made, deepest first."""
    missing: list[Path] = []
    try:
        for each in (place, *place.parents):
            if each.exists():
                break
            missing.append(each)
        place.mkdir(parents=True, exist_ok=True)
    except (OSError, ValueError) as fault:  # a name too long, or with a zero byte in it
        reason = fault.strerror if isinstance(fault, OSError) and fault.strerror else fault
        raise InputError(f"{place}: cannot be made ({reason}); needs a folder to write to") from None
    return missing


def _acquired(place: Path) -> Any:
    """The lock, held; None where the file system has none."""
    from filelock import FileLock, SoftFileLock, Timeout

    # one object per folder, so that a nested block is admitted
    lock = FileLock(place.resolve() / LOCK, timeout=_WAIT_S, is_singleton=True)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of the fall-back that is refused below
            lock.acquire(poll_interval=0.02)
    except Timeout:
        raise InputError(
            f"{place}: in use by {_holder(place / LOCK)}; needs another folder, or that process to end"
        ) from None
    except (OSError, NotImplementedError) as fault:
        if isinstance(fault, NotImplementedError) or fault.errno in _NO_LOCKS:
            return None
        raise InputError(f"{place}: cannot be written ({fault.strerror or fault})") from None
    if isinstance(lock, SoftFileLock):  # a lock by mere existence of a file would outlive a killed process
        lock.release()
        return None
    return lock


def _sign(path: Path, work: str) -> None:
    holder = {
        "pid": os.getpid(),
        "host": socket.gethostname(),
        "work": work,
        "since": f"{datetime.now(UTC):%Y-%m-%d %H:%M:%S} UTC",
    }
    with suppress(OSError):  # only the message needs it
        path.write_text(json.dumps(holder), encoding="utf-8")


def _holder(path: Path) -> str:
    """The process that holds the lock, for a message."""
    try:
        holder = json.loads(read_regular(path, most=4096, need="a lock", links=False).decode("utf-8"))
        work, pid, host, since = (printable(str(holder[key]), 80) for key in ("work", "pid", "host", "since"))
    except (ValueError, TypeError, KeyError, RecursionError):
        return "another process"
    return f"{work} (pid {pid} on {host}, since {since})"
