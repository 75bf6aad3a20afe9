"""What a damaged recording may do: be read, or be refused by one printable InputError. Nothing else, and in time."""

from __future__ import annotations

import importlib
import os
import random
import signal
import traceback
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from avtorch.errors import InputError
from avtorch.io.formats import apart_process, open_recording
from avtorch.io.formats.recognise import kind_at
from avtorch.io.recording import Channel, Recording
from tests.damage import KINDS, damaged

LATE_S = 20
"""A reader that has not answered by then will not."""


@contextmanager
def in_time(seconds: int = LATE_S) -> Iterator[None]:
    """Within it, a reader that waits or reads without end fails its test and not the whole suite."""

    def late(*_: object) -> None:
        # no Exception: a reader that turns all of those into an InputError would hide it
        raise KeyboardInterrupt(f"still reading after {seconds} s")

    before = signal.signal(signal.SIGALRM, late)
    signal.alarm(seconds)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


def open_here(path: Path, dbc: Sequence[Path] | None = None) -> Recording:
    """As `open_recording`, in this process also what is read apart: most of a short test would be that one's start."""
    kind = kind_at(path)
    if kind is None or not kind.apart:
        return open_recording(path, dbc=dbc)
    return importlib.import_module(f"avtorch.io.formats.{kind.reader}").open_file(path, kind)


def outcome(path: Path, dbc: Sequence[Path] | None = None) -> tuple[Recording, dict[str, Channel]] | str:
    """The recording with all of its channels, or the message that refuses it."""
    with in_time():
        try:
            recording = open_here(path, dbc)
            return recording, recording.read(recording.names)
        except InputError as fault:
            return str(fault)


def refused(path: Path, *words: str, dbc: Sequence[Path] | None = None) -> str:
    """The message of the InputError that opening or reading `path` raises; it names the file."""
    said = outcome(path, dbc)
    assert isinstance(said, str), "it was read"
    assert said.isprintable()
    assert len(said) < 700, said
    for word in (path.name, *words):
        assert word in said, said
    return said


def holds(path: Path, content: bytes, dbc: Sequence[Path] | None = None) -> bool:
    """Whether `content` is read; where not, it is refused as it should be.

    What is read apart is read in a copy of this process: its library may end that one, by a fault of memory only.
    """
    path.write_bytes(content)
    try:
        kind = kind_at(path)
    except InputError:
        return False
    if kind is None or not kind.apart:
        return _held(path, dbc)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # Python 3.12 warns of threads; the copy uses none
        copy = os.fork()
    if copy == 0:
        signal.alarm(LATE_S)  # not caught: it ends the copy
        try:
            apart_process._limit_memory()
            os._exit(0 if _held(path, dbc) else 1)
        except BaseException:
            traceback.print_exc()
            os._exit(2)
    code = os.waitstatus_to_exitcode(os.waitpid(copy, 0)[1])
    assert code in (0, 1, -signal.SIGSEGV, -signal.SIGABRT, -signal.SIGBUS, -signal.SIGFPE), f"status {code}"
    return code == 0


def _held(path: Path, dbc: Sequence[Path] | None) -> bool:
    said = outcome(path, dbc)
    if isinstance(said, str):
        assert said.isprintable()
        return False
    recording, channels = said
    assert tuple(channels) == recording.names
    return True


def survives(path: Path, raw: bytes, seed: int, *, cuts: int, flips: int, dbc: Sequence[Path] | None = None) -> int:
    """Cut and damage `raw` at places that `seed` tells; how many of these are still read."""
    rng = random.Random(seed)
    contents = [raw[: rng.randrange(len(raw))] for _ in range(cuts)]
    contents += [damaged(raw, i % KINDS, rng) for i in range(flips)]
    return sum(holds(path, content, dbc) for content in contents)
