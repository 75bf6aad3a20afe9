"""The loop of a live watch: pull a batch, answer, write lines of JSON to sinks, keep."""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import IO, Any, Protocol

from avtorch.errors import InputError
from avtorch.io.answers import json_text
from avtorch.live.car import LiveCar
from avtorch.live.kept_cars import KeptCars
from avtorch.live.live_watch import Answer, LiveWatch
from avtorch.live.source import Source, Stop


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


def _answered(entry: Any) -> tuple[str, int]:
    """The car and the number of the window of an answer; 0 for one that has none, as the refusal of a car.

    Raises `ValueError` or another error of bad lines for what is no answer, such as the rows of a source.
    """
    car, window = entry["car"], entry.get("window", 0)
    if type(car) is not str or type(window) is not int or "accel_cmd" in entry:
        raise ValueError("no answer")
    return car, window


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
                    car, window = _answered(json.loads(line))
                except (ValueError, TypeError, KeyError, AttributeError, RecursionError):
                    raise InputError(
                        f"{self.path}, line {number}: is no answer of avtorch watch; needs another name for --out"
                    ) from None
                if resume:
                    self._written[car] = max(window, self._written.get(car, 0))
            # what a killed run left of its last line
            stream.truncate(whole)


class Observer(Protocol):
    """Is told of every answer once it is written."""

    def answered(self, answer: Answer, car: LiveCar, seconds: float | None) -> None:
        """`seconds` from the arrival of the row that ended the window to the answer's being written."""
        ...


def watch_source(
    source: Source,
    watch: LiveWatch,
    sinks: Sequence[Sink],
    *,
    stop: Stop | None = None,
    kept: KeptCars | None = None,
    observers: Sequence[Observer] = (),
) -> None:
    """Watch the cars of `source` until it ends or `stop` is set; every answer goes to all `sinks`.

    With `kept`, the watch goes on from the state in its folder, and leaves its state there at the end, however that
    comes; open windows stay open in it. Without it they are closed early where the source ends.

    Memory is bounded: a batch is pulled once the one before it is answered and written.

    Raises `InputError` for a state that does not fit, and for what source and sinks raise.
    """
    stop = Stop() if stop is None else stop
    position = None if kept is None else kept.restore(watch)
    if kept is not None:
        kept.begin(watch)

    def tell(answers: Sequence[Answer]) -> None:
        for answer in answers:
            written = [sink.write(answer) for sink in sinks]
            if written and not any(written):
                watch.counts.repeated += 1
        for sink in sinks:
            sink.flush()
        now = time.monotonic()
        for answer in answers:
            seconds = None if answer.ended is None else now - answer.ended
            for observer in observers:
                observer.answered(answer, watch.cars[answer.car], seconds)

    start = position
    whole = True  # no batch is half taken in
    try:
        with closing(source.batches(stop, start)) as batches:
            for batch in batches:
                if batch.anew and kept is not None:
                    kept.begin_anew(watch, source.identity)
                position, whole = batch.position, False
                tell(watch.take(batch))
                whole = True
                if kept is not None:
                    kept.keep(watch, position)
        if kept is None and not stop.is_set:
            tell(watch.flush(time.monotonic()))
    finally:
        # after an error in the middle of a batch the states on disk are the ones to go on from
        if kept is not None and whole:
            kept.write(watch, position)
