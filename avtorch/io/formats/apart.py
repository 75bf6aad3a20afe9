"""A reader in a process of its own, with limits of memory and time: its library trusts what a file says of itself.

Damage has been seen to end the process (segmentation faults, 400 GB claimed by two cells), to fill its memory (pieces
that inflate without end) and to hold it for ever (a chain of blocks that returns to itself). What ends there is one
InputError here. The process lives as long as its recording, so a second reading starts at once.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import weakref
from collections.abc import Callable, Collection, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from avtorch.arrays import FloatArray
from avtorch.errors import InputError
from avtorch.io.formats.kinds import PARQUET, Kind
from avtorch.io.formats.listed import Channel, Recording
from avtorch.io.opening import place

MOST_SECONDS, SECONDS_PER_MIB = 60.0, 1.0
"""For opening, and for each reading, by the size of the file: a workbook of 20 million cells takes a third of that."""


def open_apart(path: str | os.PathLike[str], kind: Kind) -> Recording:
    """Open a recording in a process of its own. Raises InputError, also where that process ends or takes too long."""
    child = Child(path, kind)

    def load(names: tuple[str, ...]) -> dict[str, Channel]:
        answer = child.ask(names)
        clocks = [child.numbers(count) for count in answer["clocks"]]
        return {name: Channel(name, clocks[k], child.numbers(len(clocks[k]))) for name, k in answer["channels"]}

    listing = child.listing
    found = Recording(child.source, listing["form"], listing["names"], listing["units"], listing["remarks"], load)
    weakref.finalize(found, child.end)
    return found


def parquet_apart(
    path: str | os.PathLike[str], wanted: Callable[[tuple[str, ...]], Collection[str]] | None
) -> tuple[tuple[str, ...], Any]:
    """The names of all columns of a Parquet file, and the `wanted` ones (default: all) as an Arrow table.

    Raises InputError, also where the process that reads it ends or takes too long.
    """
    import pyarrow as pa

    child = Child(path, PARQUET)
    try:
        names = tuple(child.listing["names"])
        answer = child.ask(tuple(names if wanted is None else wanted(names)))
        return names, pa.ipc.open_stream(child.content(answer["bytes"])).read_all()
    finally:
        child.end()


class Child:
    """The other process: requests are lines of JSON, answers are a line of JSON and the numbers it tells of. `listing`
    is its first answer."""

    def __init__(self, path: str | os.PathLike[str], kind: Kind) -> None:
        self.source, self._words = place(path), kind.words
        self._seconds = MOST_SECONDS + SECONDS_PER_MIB * _size(path) / 2**20
        self._late = False
        # -P: nothing of the folder that the user happens to work in
        command = [sys.executable or "python", "-P", "-W", "ignore", "-m", "avtorch.io.formats.apart_process"]
        # a trace of a panic, which nobody sees, takes most of a second
        environment = dict(os.environ, RUST_BACKTRACE="0")
        environment["PYTHONPATH"] = os.pathsep.join(part for part in sys.path if part)
        try:
            self._process = subprocess.Popen(
                [*command, kind.words, os.fspath(path)],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                env=environment,
            )
        except (OSError, ValueError) as fault:
            raise InputError(f"{self.source}: no process can be started to read it ({fault})") from None
        try:
            self.listing = self._answer()
        except BaseException:
            self.end()
            raise

    def ask(self, names: Sequence[str]) -> dict[str, Any]:
        """The answer to a request for channels or columns."""
        assert self._process.stdin is not None
        with suppress(OSError):  # where it has ended, the answer tells how
            self._process.stdin.write(json.dumps(names).encode() + b"\n")
            self._process.stdin.flush()
        return self._answer()

    def content(self, size: int) -> bytes:
        """So many bytes behind an answer."""
        raw = self._within(lambda stream: stream.read(size))
        if len(raw) != size:
            raise self._ended()
        return raw

    def numbers(self, count: int) -> FloatArray:
        """So many numbers behind an answer."""
        return np.frombuffer(self.content(8 * count), dtype=np.float64).copy()

    def end(self) -> None:
        """End the process, and leave nothing of it."""
        self._process.kill()
        self._process.wait()
        for stream in (self._process.stdin, self._process.stdout):
            if stream is not None:
                with suppress(OSError):  # a request that nobody will read
                    stream.close()

    def _answer(self) -> dict[str, Any]:
        try:
            answer = json.loads(self._within(lambda stream: stream.readline()))
        except ValueError:
            raise self._ended() from None
        if "error" in answer:
            raise InputError(answer["error"])
        return answer

    def _within(self, read: Any) -> bytes:
        """What `read` takes of the answer; the process is ended when it is late."""

        def end() -> None:
            self._late = True
            self._process.kill()

        timer = threading.Timer(self._seconds, end)
        timer.daemon = True
        timer.start()
        try:
            return read(self._process.stdout)
        finally:
            timer.cancel()

    def _ended(self) -> InputError:
        if self._late:
            return InputError(
                f"{self.source}: is not read within {self._seconds:.3g} s; a smaller or an undamaged file is needed"
            )
        self._process.kill()
        code = self._process.wait()
        how = signal.Signals(-code).name if -code in signal.valid_signals() else f"status {code}"
        return InputError(
            f"{self.source}: is damaged, or takes more memory than it may: it ended the process that read it ({how}); "
            f"an undamaged {self._words} file is needed"
        )


def _size(path: str | os.PathLike[str]) -> int:
    """Bytes of a file, or of all files of a folder."""
    here = Path(path)
    try:
        return sum(file.stat().st_size for file in (here.iterdir() if here.is_dir() else (here,)))
    except (OSError, ValueError):  # its reader says so
        return 0
