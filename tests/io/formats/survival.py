"""What a damaged recording may do: be read, or be refused by one printable InputError. Nothing else, and in time."""

from __future__ import annotations

import faulthandler
import importlib
import os
import random
import signal
import traceback
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from avtorch.child_process import limit_memory
from avtorch.errors import InputError
from avtorch.io.formats import apart_process, open_recording
from avtorch.io.formats.kinds import kind_at
from avtorch.io.formats.listed import Channel, Recording
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


def open_here(path: Path) -> Recording:
    """As `open_recording`, in this process also what is read apart: most of a short test would be that one's start."""
    kind = kind_at(path)
    if kind is None:
        return open_recording(path)
    return importlib.import_module(f"avtorch.io.formats.{kind.reader}").open_file(path, kind)


def outcome(path: Path, seconds: int = LATE_S) -> tuple[Recording, dict[str, Channel]] | str:
    """The recording with all of its channels, or the message that refuses it."""
    with in_time(seconds):
        try:
            recording = open_here(path)
            return recording, recording.read(recording.names)
        except InputError as fault:
            return str(fault)


def refused(path: Path, *words: str) -> str:
    """The message of the InputError that opening or reading `path` raises; it names the file."""
    said = outcome(path)
    assert isinstance(said, str), "it was read"
    assert said.isprintable()
    assert len(said) < 700, said
    for word in (path.name, *words):
        assert word in said, said
    return said


_MOST_SECONDS = 2  # for one content, of some kilobytes; `apart.MOST_SECONDS` is for recordings


def survive(path: Path, contents: Sequence[bytes]) -> int:
    """How many of the `contents` are read; the others are refused as they should be.

    They are read in a copy of this process: a library that is to run apart may end it, by a fault of memory or because
    it reads without an end, which the process apart has no time for either. The next copy goes on behind that content.
    """
    begun, read = 0, 0
    while begun < len(contents):
        answers, theirs = os.pipe()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)  # Python 3.12 warns of threads; the copy uses none
            copy = os.fork()
        if copy == 0:
            _serve(path, contents[begun:], theirs)
        os.close(theirs)
        with os.fdopen(answers, "rb") as stream:
            said = stream.read()
        code = os.waitstatus_to_exitcode(os.waitpid(copy, 0)[1])
        at = begun + len(said)
        read += said.count(b"1")
        if code == 0:
            break
        fatal = code in (-signal.SIGSEGV, -signal.SIGABRT, -signal.SIGBUS, -signal.SIGFPE, -signal.SIGALRM)
        assert fatal, f"content {at} of {len(contents)}: status {code}"
        begun = at + 1
    return read


def _serve(path: Path, contents: Sequence[bytes], answers: int) -> None:
    """In the copy: read one after the other, and end."""
    faulthandler.disable()
    os.environ["RUST_BACKTRACE"] = "0"
    try:
        limit_memory(apart_process.MOST_MEMORY)
        for content in contents:
            path.write_bytes(content)
            os.write(answers, b"1" if _held(path) else b"0")
        os._exit(0)
    except KeyboardInterrupt:  # still reading
        signal.signal(signal.SIGALRM, signal.SIG_DFL)
        signal.raise_signal(signal.SIGALRM)
    except BaseException:
        traceback.print_exc()
        os._exit(2)


def _held(path: Path) -> bool:
    said = outcome(path, _MOST_SECONDS)
    if isinstance(said, str):
        assert said.isprintable()
        return False
    recording, channels = said
    assert tuple(channels) == recording.names
    return True


def survives(path: Path, raw: bytes, seed: int, *, cuts: int, flips: int) -> int:
    """Cut and damage `raw` at places that `seed` tells; how many of these are still read."""
    rng = random.Random(seed)
    contents = [raw[: rng.randrange(len(raw))] for _ in range(cuts)]
    contents += [damaged(raw, i % KINDS, rng) for i in range(flips)]
    return survive(path, contents)
