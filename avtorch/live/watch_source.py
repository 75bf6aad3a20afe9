"""The loop of a live watch: pull a batch, answer, write lines of JSON to sinks, keep the cars' state in a file.

The state is that of all cars after a batch: their beliefs with draws and random numbers, their open windows, the rows
kept back for re-ordering, and the position in the source up to which its rows are in it. It appears whole or not at
all; the same windows as before a kill have the same numbers, by which a file of answers knows them.
"""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import closing
from pathlib import Path
from threading import Event
from typing import IO, Any, Protocol

from avtorch.errors import InputError
from avtorch.inference.stream import packed, unpacked
from avtorch.io import read_sealed_bytes, write_sealed
from avtorch.io.answers import json_text
from avtorch.live.car import Answer, LiveCar, LiveWatch
from avtorch.live.source import Source
from avtorch.version import __version__

STATE = "avtorch.live/1"
MOST = 2**30
"""Bytes of a state at most; it takes some 0.1 MB a car."""
EVERY_S = 10.0
"""Wall-clock time after which the state is written anew [s]: what is computed again at most after a kill."""
REMEDY = "use the same settings, or another folder for --state"


class KeptCars:
    """The state in `folder`, of a watch of the source called `identity`.

    Raises `InputError` where the folder cannot be used, and for a damaged state.
    """

    def __init__(self, folder: str | Path, identity: str | None = None) -> None:
        self.folder, self.path = Path(folder), Path(folder) / "watch.state"
        self._of: dict[str, Any] = {}
        self._found: dict[str, Any] | None = None
        if self.path.exists():
            self._of, content = read_sealed_bytes(self.path, schema=STATE, most=MOST, remedy=REMEDY)
            self._found = unpacked(content, self.path, REMEDY)
        self.same_source = self._found is not None and identity is not None and self._found["source"] == identity
        """Whether the state is of this very source, which can be read on from where it ends."""
        self._due = 0.0

    def restore(self, watch: LiveWatch) -> int | None:
        """Bring `watch` to the state in the folder; returns the position to read the source from, None for its start.

        Raises `InputError` for a state of other settings.
        """
        if self._found is None:
            return None
        for name, value in _work(watch).items():
            if self._of.get(name) != value:
                found = str(self._of.get(name))[:40]
                raise InputError(f"{self.path}: was begun with {name} {found}, not {value}; {REMEDY}")
        watch.counts.load(self._found["counts"])
        for state in self._found["cars"]:
            car = LiveCar.restored(state, watch.settings, watch.counts)
            watch.cars[car.name] = car
        return self._found["position"] if self.same_source else None

    def keep(self, watch: LiveWatch, position: int | None, identity: str | None) -> None:
        """Write the state now and then, of a source that was read up to `position`; at once where there is none, so
        that a run killed before its first window is known to be of it, too."""
        if time.monotonic() >= self._due:
            self.write(watch, position, identity)

    def write(self, watch: LiveWatch, position: int | None, identity: str | None) -> None:
        """Write the state."""
        cars = [car.state_dict() for car in watch.cars.values()]
        state = {"source": identity, "position": position, "counts": watch.counts.to_dict(), "cars": cars}
        write_sealed(self.path, packed(state), schema=STATE, of=_work(watch))
        self._due = time.monotonic() + EVERY_S


def _work(watch: LiveWatch) -> dict[str, str]:
    """What a state belongs to, by name."""
    return {**watch.settings.to_dict(), "avtorch": __version__}


class Sink(Protocol):
    """Takes answers; `flush` is called behind every batch. It may wait, and the source then waits too."""

    def write(self, answer: Answer) -> bool:
        """Take an answer; false where an earlier run had written it."""
        ...

    def flush(self) -> None:
        """Send what was taken."""
        ...

    def close(self) -> None:
        """Send what was taken, and end."""
        ...


def line_of(answer: Answer) -> str:
    """The answer as one line of JSON, with its line end."""
    return json_text(answer.entry, indent=None, ascii_only=True).strip() + "\n"


class LineSink:
    """Lines to an open text stream, standard output by default."""

    def __init__(self, stream: IO[str] | None = None) -> None:
        self._stream = sys.stdout if stream is None else stream

    def write(self, answer: Answer) -> bool:
        self._stream.write(line_of(answer))
        return True

    def flush(self) -> None:
        self._stream.flush()

    def close(self) -> None:
        self._stream.flush()


class FileSink(LineSink):
    """Lines appended to a file. With `resume` a line that was cut short is removed, and windows that the file holds are
    not written again: a run that was killed and started again leaves the file of one that was not.

    Raises `InputError` where it cannot be written, or holds other lines.
    """

    def __init__(self, path: str | os.PathLike[str], *, resume: bool = False) -> None:
        self.path = Path(path)
        self._written: dict[str, int] = {}
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            if self.path.exists():
                self._look(resume)
            stream = open(self.path, "a", encoding="utf-8", newline="")  # noqa: SIM115 (closed by close)
        except OSError as fault:
            raise InputError(f"{self.path}: cannot be written ({fault.strerror or fault})") from None
        super().__init__(stream)

    def write(self, answer: Answer) -> bool:
        if answer.number <= self._written.get(answer.car, 0):
            return False
        return super().write(answer)

    def close(self) -> None:
        self._stream.close()

    def _look(self, resume: bool) -> None:
        """The last window of each car in the file, and its last line made whole."""
        if not self.path.is_file():
            raise InputError(f"{self.path}: is no regular file; a file for lines of JSON is needed")
        whole = 0
        with open(self.path, "rb+") as stream:
            for number, line in enumerate(stream, 1):
                if not line.endswith(b"\n"):
                    break
                whole += len(line)
                try:
                    entry = json.loads(line)
                    # 0 for the refusal of a car
                    car, window = entry["car"], entry.get("window", 0)
                except (ValueError, TypeError, KeyError, RecursionError):
                    entry, car, window = {}, None, None
                if type(car) is not str or type(window) is not int or "accel_cmd" in entry:
                    raise InputError(
                        f"{self.path}, line {number}: is no answer of avtorch watch; needs another name for --out"
                    )
                if resume:
                    self._written[car] = max(window, self._written.get(car, 0))
            # what a killed run left of its last line
            stream.truncate(whole)


def watch_source(
    source: Source,
    watch: LiveWatch,
    sinks: Sequence[Sink],
    *,
    stop: Event | None = None,
    kept: KeptCars | None = None,
    answered: Callable[[Answer, LiveCar, float | None], None] | None = None,
) -> None:
    """Watch the cars of `source` until it ends or `stop` is set; every answer goes to all `sinks`.

    `answered` is called with each answer once it is written, its car, and the seconds from the arrival of the row that
    ended the window.

    With `kept`, the watch goes on from the state in its folder, and leaves its state there at the end, however that
    comes; open windows stay open in it. Without it they are closed early where the source ends.

    Memory is bounded: a batch is pulled once the one before it is answered and written.

    Raises `InputError` for a state that does not fit, and for what source and sinks raise.
    """
    stop = Event() if stop is None else stop
    position, identity = None if kept is None else kept.restore(watch), source.identity

    def tell(answers: Sequence[Answer]) -> None:
        for answer in answers:
            written = [sink.write(answer) for sink in sinks]
            if written and not any(written):
                watch.counts.repeated += 1
        for sink in sinks:
            sink.flush()
        now = time.monotonic()
        for answer in answers:
            if answered is not None:
                answered(answer, watch.cars[answer.car], None if answer.ended is None else now - answer.ended)

    whole = True  # no batch is half taken in
    try:
        with closing(source.batches(stop, position)) as batches:
            if kept is not None:
                kept.keep(watch, position, identity)
            for batch in batches:
                whole = False
                tell(watch.take(batch))
                position, identity, whole = batch.position, source.identity, True
                if kept is not None:
                    kept.keep(watch, position, identity)
        if kept is None and not stop.is_set():
            tell(watch.flush(time.monotonic()))
    finally:
        # after an error in the middle of a batch the state on disk is the one to go on from
        if kept is not None and whole:
            kept.write(watch, position, identity)
