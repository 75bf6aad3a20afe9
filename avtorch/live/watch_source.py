"""The loop of a live watch: pull a batch, answer, write, keep."""

from __future__ import annotations

import time
from collections.abc import Sequence
from contextlib import closing
from typing import Protocol

from avtorch.live.car import LiveCar
from avtorch.live.kept_cars import KeptCars
from avtorch.live.live_watch import Answer, LiveWatch
from avtorch.live.sink import Sink
from avtorch.live.source import Source, Stop


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

    Example:
        >>> import io
        >>> from avtorch.live import Batch, LineSink, LiveWatch, Row, watch_source
        >>> class Steady:
        ...     name, identity = "a steady drive", None
        ...     def batches(self, stop, start=None):
        ...         signals = {"accel_cmd": 0.0, "speed": 20.0}
        ...         yield Batch([Row("red", 0.01 * i, signals) for i in range(250)])
        >>> told, watch = io.StringIO(), LiveWatch()
        >>> watch_source(Steady(), watch, [LineSink(told)])
        >>> told.getvalue().count('"excited": false'), watch.counts.windows
        (2, 2)
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
