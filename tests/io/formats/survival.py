"""What a damaged recording may do: be read, or be refused by one printable InputError. Nothing else, and in time."""

from __future__ import annotations

import random
import signal
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from avtorch.errors import InputError
from avtorch.io.formats import open_recording
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


def outcome(path: Path, dbc: Sequence[Path] | None = None) -> tuple[Recording, dict[str, Channel]] | str:
    """The recording with all of its channels, or the message that refuses it."""
    with in_time():
        try:
            recording = open_recording(path, dbc=dbc)
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
    """Whether `content` is read; where not, it is refused as it should be."""
    path.write_bytes(content)
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
