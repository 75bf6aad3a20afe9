"""A reader in a process of its own, with limits of memory and time: its library trusts what a file says of itself.

Damage has been seen to end the process (segmentation faults, 400 GB claimed by two cells), to fill its memory (pieces
that inflate without end) and to hold it for ever (a chain of blocks that returns to itself). What ends there is one
InputError here. A process answers one request and ends: what a file has, and what of it was asked for.
"""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
from collections.abc import Collection
from pathlib import Path
from typing import Any

import numpy as np

from avtorch.errors import InputError
from avtorch.io.formats.kinds import NEED, PARQUET, Kind, kind_at
from avtorch.io.formats.listed import Channel, Recording
from avtorch.io.opening import place

Wanted = Collection[str] | re.Pattern[str] | None
"""Channels or columns to read, by their names or by what these match; None: all."""

MOST_SECONDS, SECONDS_PER_MIB = 60.0, 1.0
"""For each request, by the size of the file: a workbook of 20 million cells takes a third of that."""


def open_recording(path: str | os.PathLike[str], names: Collection[str] = ()) -> Recording:
    """Open a recording; its format is recognised by how it begins, then by its suffix.

    A CAN log is decoded by the ``.dbc`` of its name beside it, or the only one in its folder. Names are listed and no
    samples are read, except where a format has to be read to be listed (MAT before 7.3, Excel). What it has of `names`
    is read as it is opened, other channels by another process.

    Raises InputError naming the file: for what is no regular file or no recording, for a damaged one, for one whose
    library is not installed (with the command that installs it), and for a CAN log without a database.
    """
    kind = kind_at(path)
    if kind is None:
        what = "a directory without the metadata.yaml of a ROS 2 bag" if os.path.isdir(path) else "no recording"
        raise InputError(f"{place(path)}: is {what}; {NEED} is needed")
    listing, first = _asked(path, kind, names)
    there = _channels(listing, first)

    def load(wanted: tuple[str, ...]) -> dict[str, Channel]:
        return there if there.keys() >= set(wanted) else _channels(*_asked(path, kind, wanted))

    return Recording(place(path), listing["form"], listing["names"], listing["units"], listing["remarks"], load)


def parquet_apart(path: str | os.PathLike[str], wanted: Wanted) -> tuple[tuple[str, ...], Any]:
    """The names of all columns of a Parquet file, and the `wanted` ones as an Arrow table.

    Raises InputError, also where the process that reads it ends or takes too long.
    """
    import pyarrow as pa

    listing, stream = _asked(path, PARQUET, wanted)
    return tuple(listing["names"]), pa.ipc.open_stream(stream).read_all()


def _channels(listing: dict[str, Any], numbers: memoryview) -> dict[str, Channel]:
    """The channels that an answer brings: behind it stand the clocks, then the values of each."""
    rows = listing["clocks"]
    sizes = [*rows, *(rows[k] for _, k in listing["channels"])]
    arrays = np.split(np.frombuffer(numbers).copy(), np.cumsum(sizes)[:-1])
    values = arrays[len(rows) :]
    return {name: Channel(name, arrays[k], x) for (name, k), x in zip(listing["channels"], values, strict=False)}


def _asked(path: str | os.PathLike[str], kind: Kind, wanted: Wanted) -> tuple[dict[str, Any], memoryview]:
    """What a process says of a file, a line of JSON, and the bytes of what is `wanted` behind it."""
    asked = wanted.pattern if isinstance(wanted, re.Pattern) else None if wanted is None else list(wanted)
    source, seconds = place(path), MOST_SECONDS + SECONDS_PER_MIB * _size(path) / 2**20
    # -P: nothing of the folder that the user happens to work in
    command = [sys.executable or "python", "-P", "-W", "ignore", "-m", "avtorch.io.formats.apart_process"]
    # a trace of a panic, which nobody sees, takes most of a second
    environment = dict(os.environ, RUST_BACKTRACE="0")
    environment["PYTHONPATH"] = os.pathsep.join(part for part in sys.path if part)
    try:
        done = subprocess.run(
            [*command, kind.words, os.fspath(path)],
            input=json.dumps(asked).encode(),
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env=environment,
            timeout=seconds,
            check=False,
        )
    except subprocess.TimeoutExpired:
        raise InputError(
            f"{source}: is not read within {seconds:.3g} s; a smaller or an undamaged file is needed"
        ) from None
    except (OSError, ValueError) as fault:
        raise InputError(f"{source}: no process can be started to read it ({fault})") from None
    line = done.stdout[: done.stdout.find(b"\n") + 1]
    content = memoryview(done.stdout)[len(line) :]
    try:
        answer = json.loads(line)
    except ValueError:
        answer = {}
    if "error" in answer:
        raise InputError(answer["error"])
    if len(content) != answer.get("bytes"):
        code = -done.returncode
        how = signal.Signals(code).name if code in signal.valid_signals() else f"status {done.returncode}"
        raise InputError(
            f"{source}: is damaged, or takes more memory than it may: it ended the process that read it ({how}); "
            f"an undamaged {kind.words} file is needed"
        )
    return answer, content


def _size(path: str | os.PathLike[str]) -> int:
    """Bytes of a file, or of all files of a folder."""
    here = Path(path)
    try:
        return sum(file.stat().st_size for file in (here.iterdir() if here.is_dir() else (here,)))
    except (OSError, ValueError):  # its reader says so
        return 0
