"""Lines of standard input or of a file, which may go on growing."""

from __future__ import annotations

import os
import select
import time
from collections.abc import Generator, Iterator
from pathlib import Path
from threading import Event
from typing import BinaryIO

from avtorch.io.opening import opened
from avtorch.live.source import LONGEST, Batch, LineParser

CHUNK = 2**16
"""Bytes read at once."""
POLL_S = 0.02
"""How often a file is looked at for new lines [s]."""
WAIT_S = 0.2
"""How long standard input is waited for before the watch looks around [s]."""


class _Lines:
    """Bytes to whole lines, each with the position behind it; a line without an end is held to a bound."""

    def __init__(self, position: int = 0) -> None:
        self.position = position
        self._rest = b""

    def of(self, chunk: bytes) -> Iterator[tuple[bytes, int]]:
        *lines, self._rest = (self._rest + chunk).split(b"\n")
        for line in lines:
            self.position += len(line) + 1
            yield line, self.position
        if len(self._rest) > LONGEST:  # refused for its length, and what follows of it as no row
            yield from self.last()

    def last(self) -> Iterator[tuple[bytes, int]]:
        """What no line end follows."""
        rest, self._rest = self._rest, b""
        self.position += len(rest)
        yield rest, self.position


def _batch(
    parser: LineParser, lines: Iterator[tuple[bytes, int]], at: _Lines, *, seekable: bool, anew: bool = False
) -> Batch:
    arrived = time.monotonic()
    parsed = [parser.row(line, position if seekable else None) for line, position in lines]
    rows = [row for row in parsed if row is not None]
    return Batch(rows, at.position if seekable else None, anew, arrived)


class StreamSource:
    """Lines of an open descriptor, standard input by default, until it ends."""

    name = "standard input"
    identity = None

    def __init__(self, parser: LineParser, descriptor: int = 0) -> None:
        self.parser, self._descriptor = parser, descriptor

    def batches(self, stop: Event, start: int | None = None) -> Generator[Batch, None, None]:
        """As the contract; there is nothing to go back to, so `start` has no meaning."""
        lines = _Lines()
        while not stop.is_set():
            # a descriptor that is read without waiting could not be stopped while it is silent
            if not select.select([self._descriptor], [], [], WAIT_S)[0]:
                yield Batch([])
                continue
            chunk = os.read(self._descriptor, CHUNK)
            if not chunk:
                yield _batch(self.parser, lines.last(), lines, seekable=False)
                return
            yield _batch(self.parser, lines.of(chunk), lines, seekable=False)


class FileSource:
    """Lines of a file; with `follow`, also those written to it later, and those of a file that takes its place.

    Raises `InputError` where it cannot be read.
    """

    def __init__(self, path: str | os.PathLike[str], parser: LineParser, *, follow: bool = False) -> None:
        self.path, self.parser, self.follow = Path(path), parser, follow
        self._file: BinaryIO | None = None
        self._opened().close()

    @property
    def name(self) -> str:
        return str(self.path)

    @property
    def identity(self) -> str | None:
        """The path and the file behind it: a file that takes its place is another."""
        found = os.stat(self.path) if self._file is None else os.fstat(self._file.fileno())
        return f"{self.path.absolute()} {found.st_ino}"

    def batches(self, stop: Event, start: int | None = None) -> Generator[Batch, None, None]:
        """As the contract; `start` in bytes."""
        self._file = file = self._opened()
        try:
            lines, anew = self._begun(file, start)
            while not stop.is_set():
                chunk = file.read(CHUNK)
                if chunk:
                    yield _batch(self.parser, lines.of(chunk), lines, seekable=True, anew=anew)
                    anew = False
                elif not self.follow:
                    yield _batch(self.parser, lines.last(), lines, seekable=True)
                    return
                elif self._replaced(file, lines.position):
                    yield _batch(self.parser, lines.last(), lines, seekable=True)
                    file.close()
                    self._file = file = self._opened()
                    self.parser.header = None
                    lines, anew = _Lines(), True
                else:
                    yield Batch([], lines.position)
                    time.sleep(POLL_S)
        finally:
            file.close()
            self._file = None

    def _begun(self, file: BinaryIO, start: int | None) -> tuple[_Lines, bool]:
        """Where to read from, and whether that is the start again of a file that was cut."""
        size = os.fstat(file.fileno()).st_size
        if start is None or start > size:
            return _Lines(), start is not None
        # a CSV's header, or what shows that it is JSON, is of every run
        before = self.parser.counts.to_dict()
        while self.parser.header is None and file.tell() < start and (line := file.readline(LONGEST)):
            self.parser.row(line)
        self.parser.counts.load(before)
        if file.tell() <= start:
            file.seek(start)
            return _Lines(start), False
        self.parser.header = None
        file.seek(0)
        return _Lines(), False

    def _replaced(self, file: BinaryIO, position: int) -> bool:
        """Whether the file was cut, or another has its name."""
        try:
            now = os.stat(self.path)
        except OSError:
            return False  # moved away, and its successor yet to come
        mine = os.fstat(file.fileno())
        return (now.st_ino, now.st_dev) != (mine.st_ino, mine.st_dev) or mine.st_size < position

    def _opened(self) -> BinaryIO:
        return opened(self.path, need="a file of rows, or - for standard input,")
