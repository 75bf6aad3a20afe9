"""What a damaged recording may do: be read, or be refused by one printable InputError. Nothing else, and in time."""

from __future__ import annotations

import random
import signal
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from avtorch.errors import InputError
from avtorch.io.formats import open_recording
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


def refused(path: Path, *words: str, dbc: Sequence[Path] | None = None) -> str:
    """The message of the InputError that opening or reading `path` raises; it names the file."""
    with pytest.raises(InputError) as fault, in_time():
        recording = open_recording(path, dbc=dbc)
        recording.read(recording.names)
    said = str(fault.value)
    assert said.isprintable()
    assert len(said) < 700, said
    for word in (path.name, *words):
        assert word in said, said
    return said


def survives(path: Path, raw: bytes, seed: int, *, cuts: int, flips: int, dbc: Sequence[Path] | None = None) -> int:
    """Cut and damage `raw` at places that `seed` tells; how many of these are still read."""
    rng = random.Random(seed)
    contents = [raw[: rng.randrange(len(raw))] for _ in range(cuts)]
    contents += [damaged(raw, i % KINDS, rng) for i in range(flips)]
    read = 0
    for content in contents:
        path.write_bytes(content)
        with in_time():
            try:
                recording = open_recording(path, dbc=dbc)
                channels = recording.read(recording.names)
            except InputError as fault:
                assert str(fault).isprintable()
                continue
        read += 1
        for name in recording.names:
            assert channels[name].time.dtype == np.float64
    return read
