"""The loop of a live watch: pull a batch, answer, write lines of JSON to sinks, keep the cars' states in a folder.

Each car has a file of its own: its belief with draws and random numbers, its open window, the rows kept back for
re-ordering, and the position in the source up to which its rows are in it. Files are written one after the other
between batches, so that no answer waits for all of them. A record beside them holds the position from which the source
has to be read: rows that a car has taken in already are passed over. Each file appears whole or not at all.
"""

from __future__ import annotations

import hashlib
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
from avtorch.io import read_sealed, read_sealed_bytes, write_sealed
from avtorch.io.answers import json_text
from avtorch.live.car import Answer, LiveCar, LiveWatch
from avtorch.live.source import Source
from avtorch.version import __version__

CAR, RECORD = "avtorch.live_car/2", "avtorch.live_source/2"
MOST = 2**28
"""Bytes of a car's state at most; it takes some 0.1 MB."""
EVERY_S = 10.0
"""Wall-clock time after which a car's new state is written [s]: what is computed again at most after a kill."""
REMEDY = "use the same settings, or another folder for --state"


class KeptCars:
    """The states in `folder`, of a watch of the source called `identity`.

    Raises `InputError` where the folder cannot be used.
    """

    def __init__(self, folder: str | Path, identity: str | None = None) -> None:
        self.folder, self.identity = Path(folder), identity
        self._record_path = self.folder / "source.json"
        there = self._record_path.exists()
        self._found = read_sealed(self._record_path, schema=RECORD, remedy=REMEDY) if there else None
        self._written: dict[str, tuple[float, int | None]] = {}  # by car: when, and the position that its file holds
        self._begun: int | None = None
        self._recorded = time.monotonic()
        self._next = 0.0

    @property
    def same_source(self) -> bool:
        """Whether the folder holds states of this very source, which can be read on from where they end."""
        found = self._found
        return found is not None and self.identity is not None and found.content["source"] == self.identity

    def restore(self, watch: LiveWatch) -> int | None:
        """Bring `watch` to the state in the folder, and name the source there; returns the position to read it from,
        None for its start.

        Raises `InputError` for states of other settings, and for damaged ones.
        """
        if self._found is None:
            # so that a run killed before its first state is known to be of it, too
            self._record(watch, None)
            return None
        self._same(self._found.of, watch, self._record_path)
        watch.counts.load(self._found.content["counts"])
        same = self.same_source
        for path in sorted(self.folder.glob("*.car")):
            sealed = read_sealed_bytes(path, schema=CAR, most=MOST, remedy=REMEDY)
            self._same(sealed.of, watch, path)
            try:
                car = LiveCar.restored(unpacked(sealed.content, path, REMEDY), watch.settings, watch.counts)
            except InputError as fault:
                raise InputError(f"{path}: {fault}; {REMEDY}") from None
            car.position = car.position if same else None
            watch.cars[car.name] = car
            self._written[car.name] = time.monotonic(), car.position
        self._begun = self._found.content["position"] if same else None
        return self._begun

    def begin_anew(self, watch: LiveWatch, identity: str | None) -> None:
        """Positions count from 0 again, in a source of another identity; all states are written."""
        self.identity, self._begun = identity, None
        self.write(watch)

    def keep(self, watch: LiveWatch, position: int | None) -> None:
        """Write the state of one car whose turn it is, if any, and the record now and then."""
        now = time.monotonic()
        if now < self._next:
            return
        self._next = now + EVERY_S / max(200, 2 * len(watch.cars))  # so that each has its turn
        for name in watch.cars:
            self._written.setdefault(name, (now, self._begun))
        due = min(self._written, key=lambda name: self._written[name][0], default=None)
        if due is not None and now - self._written[due][0] >= EVERY_S:
            self._write_car(watch, watch.cars[due])
        if now - self._recorded >= EVERY_S:
            self._recorded = now
            behind = [at for name, (_, at) in self._written.items() if watch.cars[name].position != at]
            known = [at for at in behind if at is not None]
            self._record(watch, position if not behind else min(known) if len(known) == len(behind) else self._begun)

    def write(self, watch: LiveWatch, position: int | None = None) -> None:
        """Write all states and the record, at the end."""
        for car in watch.cars.values():
            self._write_car(watch, car)
        self._record(watch, position)

    def _write_car(self, watch: LiveWatch, car: LiveCar) -> None:
        name = hashlib.sha256(car.name.encode("utf-8", "surrogatepass")).hexdigest()[:24]
        path = self.folder / f"{name}.car"
        write_sealed(path, packed(car.state_dict()), schema=CAR, of=_work(watch))
        self._written[car.name] = time.monotonic(), car.position

    def _record(self, watch: LiveWatch, position: int | None) -> None:
        content = {"source": self.identity, "position": position, "counts": watch.counts.to_dict()}
        write_sealed(self._record_path, content, schema=RECORD, of=_work(watch))

    @staticmethod
    def _same(of: dict[str, Any], watch: LiveWatch, path: Path) -> None:
        """Raises `InputError` that names the setting in which a state differs from the watch."""
        for name, value in _work(watch).items():
            if of.get(name) != value:
                raise InputError(f"{path}: was begun with {name} {str(of.get(name))[:40]}, not {value}; {REMEDY}")


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
    position = None if kept is None else kept.restore(watch)

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
            for batch in batches:
                if batch.anew and kept is not None:
                    kept.begin_anew(watch, source.identity)
                position, whole = batch.position, False
                tell(watch.take(batch))
                whole = True
                if kept is not None:
                    kept.keep(watch, position)
        if kept is None and not stop.is_set():
            tell(watch.flush(time.monotonic()))
    finally:
        # after an error in the middle of a batch the states on disk are the ones to go on from
        if kept is not None and whole:
            kept.write(watch, position)
