"""What every live source gives, rows of cars in batches of bounded size, and those of lines and of recordings.

A source is pulled. What it has not been asked for stays in the pipe, the file or the broker's queue, so that memory
does not grow where the estimate is behind. What becomes of messages that are no rows is counted by kind, and no line
of JSON or CSV can stop the watch.
"""

from __future__ import annotations

import csv
import json
import os
import select
import time
from collections import Counter
from collections.abc import Generator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from threading import Event
from typing import Any, BinaryIO, NamedTuple, Protocol

import numpy as np

from avtorch.errors import InputError, printable
from avtorch.io import Log
from avtorch.io.log import no_command
from avtorch.io.mapping import Pairs, pairs
from avtorch.io.opening import opened
from avtorch.io.sealed import fingerprint
from avtorch.io.units import to_si
from avtorch.numeral import numeral


class Row(NamedTuple):
    """One row of one car: its `time` [s] on the car's own clock, and `signals` in SI units, as numbers or as a source
    found them.
    """

    car: str
    time: float
    signals: Mapping[str, Any]


@dataclass(frozen=True)
class Batch:
    """Rows read at once, maybe none; `position` in the source behind them; `arrived` when (`time.monotonic`)."""

    rows: list[Row]
    position: int | None = None
    arrived: float = field(default_factory=time.monotonic)


class Source(Protocol):
    """Where rows come from."""

    @property
    def identity(self) -> str | None:
        """What a position belongs to; None where the source cannot be read again."""
        ...

    def batches(self, stop: Event, start: int | None = None) -> Generator[Batch, None, None]:
        """Batches until the source ends or `stop` is set, which it looks at every fifth of a second; empty ones while
        nothing comes. `start`: a position to read on from."""
        ...


REFUSED = {
    "corrupt": "no JSON object, no row of the CSV header's length, or a line that is too long",
    "incomplete": "without a time or a signal that the car's first row had",
    "implausible": "a number that is not finite, or that no car reaches",
    "doubled": "of a time that the car has sent already",
    "late": "older than the rows that have been given to the estimate",
    "jumped": "more than a minute from the rows before and after it",
    "crowded": "beyond the greatest number of rows in a window",
    "too many cars": "of a car beyond the greatest number of cars",
    "contradictory": "of columns that contradict each other in unit or sign",
    "failed": "of a window that could not be computed",
}
"""Why a message or a row was left out, by kind."""


class Counts:
    """Numbers since the first start: `rows` taken in, `refused` by kind, `reordered` rows that were put in their place,
    `windows`, `alerts` by detector, `repeated` lines that an earlier run had written.
    """

    def __init__(self) -> None:
        self.rows = self.reordered = self.windows = self.repeated = 0
        self.refused: Counter[str] = Counter()
        self.alerts: Counter[str] = Counter()

    def refuse(self, kind: str, many: int = 1) -> None:
        """Count `many` rows or messages left out for this reason, a key of `REFUSED`."""
        self.refused[kind] += many

    def to_dict(self) -> dict[str, Any]:
        """The numbers as plain objects."""
        return {**vars(self), "refused": dict(self.refused), "alerts": dict(self.alerts)}

    def load(self, state: Mapping[str, Any]) -> None:
        """Go on from `to_dict`."""
        vars(self).update(state)
        self.refused, self.alerts = Counter(state["refused"]), Counter(state["alerts"])


SIGNALS = ("accel_cmd", "accel", "speed", "jerk", "engaged")
"""Signals that a watch uses; a row needs `accel_cmd`, and `accel` or `speed`."""
LONGEST = 2**20
"""Bytes of a line; a longer one is corrupt."""
_CAR = 200  # characters of a car's name


class LineParser:
    """Lines to rows, JSON or CSV as the first line shows.

    A line of JSON is an object with `time` [s], the signals, and `car` where there are several. CSV begins with a
    header of the same names. `map` names other columns and `unit` other units, as for `Log.read`; `car` is the name
    where a row has none. What is no row is counted in `counts`.

    Raises `InputError` for a mapping or unit that is not known.
    """

    def __init__(self, counts: Counts, *, map: Pairs = None, unit: Pairs = None, car: str = "car") -> None:
        self.counts, self.car = counts, car
        columns = pairs("map", map)
        units = pairs("unit", unit)
        for name in (*columns, *units):
            if name not in (*SIGNALS, "time"):
                raise InputError(f"map, unit: found {name}, needs time or one of {', '.join(SIGNALS)}")
        self._time = columns.get("time", "time")
        self._columns = [(name, columns.get(name, name)) for name in SIGNALS]
        one = np.ones(1)
        self._factors = {name: float(to_si(name, text)(one)[0]) for name, text in units.items()}
        self._second = self._factors.pop("time", 1.0)
        self.header: list[str] | None = None
        """Of CSV; empty where the first line was JSON. None before it, as where another file takes the place."""

    def row(self, line: bytes) -> Row | None:
        """The row of a line; None for an empty line, a header, and what was counted as refused."""
        if not line.strip():
            return None
        if self.header is None:
            line = line.removeprefix(b"\xef\xbb\xbf")
            if line.lstrip().startswith((b"{", b"[")):
                self.header = []
        if len(line) > LONGEST:
            return self._refused("corrupt")
        return self._of_json(line, self.car) if self.header == [] else self._of_csv(line)

    def message(self, payload: bytes, *, car: str) -> list[Row]:
        """The rows of a message: an object, several in a list, or one a line; `car` names the car of those without."""
        if len(payload) > LONGEST:
            self._refused("corrupt")
            return []
        if not payload.lstrip().startswith(b"["):
            rows = [self._of_json(line, car) for line in payload.splitlines() if line.strip()]
            return [row for row in rows if row is not None]
        try:
            found = json.loads(payload)
        except (ValueError, RecursionError):
            self._refused("corrupt")
            return []
        return [row for one in found if (row := self._of_object(one, car)) is not None]

    def _of_json(self, text: bytes, car: str) -> Row | None:
        try:
            found = json.loads(text.decode())  # of bytes it would look for the encoding first
        except (ValueError, RecursionError):
            return self._refused("corrupt")
        return self._of_object(found, car)

    def _of_object(self, found: Any, car: str) -> Row | None:
        if type(found) is not dict:
            return self._refused("corrupt")
        car = found.get("car", car)
        if type(car) is int:
            car = str(car)
        if type(car) is not str:
            return self._refused("corrupt")
        time = found.get(self._time)
        if time is None:
            return self._refused("incomplete")
        # as false as text: a number in quotation marks is one that somebody meant to be a word
        if type(time) not in (float, int) or not -1e15 < time < 1e15:
            return self._refused("implausible")
        if not 0 < len(car) <= _CAR:
            return self._refused("corrupt")
        signals = {name: found[column] for name, column in self._columns if column in found}
        try:
            car.encode()  # JSON may hold half of a surrogate pair
            for name, factor in self._factors.items():
                if signals.get(name) is not None:
                    signals[name] *= factor
        except UnicodeEncodeError:
            return self._refused("corrupt")
        except (TypeError, OverflowError):  # an integer of four hundred digits is no float
            return self._refused("implausible")
        return Row(car, time * self._second, signals)

    def _of_csv(self, line: bytes) -> Row | None:
        try:
            cells = [cell.strip() for cell in next(csv.reader([line.decode()]))]
        except (UnicodeDecodeError, csv.Error, StopIteration):
            return self._refused("corrupt")
        if self.header is None:
            self.header = self._checked(cells)
            return None
        if cells == self.header:  # of a file begun again
            return None
        if len(cells) != len(self.header):
            return self._refused("corrupt")
        found = {name: cell if name == "car" else _number(cell) for name, cell in zip(self.header, cells, strict=True)}
        return self._of_object(found | {"car": found.get("car") or self.car}, self.car)

    def _checked(self, cells: list[str]) -> list[str]:
        names = {name for name, column in self._columns if column in cells}
        if self._time not in cells or "accel_cmd" not in names or not names & {"accel", "speed"}:
            found = printable(", ".join(cells), 120)
            raise InputError(
                f"the source's first line: found {found}; needs a JSON object, or a CSV header with time, accel_cmd, "
                "and accel or speed (--map names other columns)"
            )
        return cells

    def _refused(self, kind: str) -> None:
        self.counts.refuse(kind)


def _number(text: str) -> float | str | None:
    """A cell's number; None where it is empty, and the text itself where it is no number."""
    if not text:
        return None
    try:
        return numeral(text)
    except ValueError:
        return text


CHUNK = 2**16
"""Bytes read at once."""
POLL_S = 0.02
"""How often a file is looked at for new lines [s]."""
WAIT_S = 0.2
"""How long standard input is waited for before the watch looks around [s]."""


class _Lines:
    """Bytes to rows by whole lines; `position` is behind them. A line without an end is held to a bound."""

    def __init__(self, parser: LineParser, position: int = 0) -> None:
        self.parser, self.position = parser, position
        self._rest = b""

    def rows(self, chunk: bytes) -> list[Row]:
        """Those that end in a chunk; at the source's end, an empty one, also the one that no line end follows."""
        *lines, self._rest = (self._rest + chunk).split(b"\n")
        self.position += sum(len(line) + 1 for line in lines)
        if not chunk or len(self._rest) > LONGEST:  # refused for its length, and what follows of it as no row
            self.position += len(self._rest)
            lines.append(self._rest)
            self._rest = b""
        return [row for line in lines if (row := self.parser.row(line)) is not None]


class StreamSource:
    """Lines of an open descriptor, standard input by default, until it ends."""

    identity = None

    def __init__(self, parser: LineParser, descriptor: int = 0) -> None:
        self.parser, self._descriptor = parser, descriptor

    def batches(self, stop: Event, start: int | None = None) -> Generator[Batch, None, None]:
        """As the contract; there is nothing to go back to, so `start` has no meaning."""
        lines, chunk = _Lines(self.parser), None
        while chunk != b"" and not stop.is_set():
            # a descriptor that is read without waiting could not be stopped while it is silent
            if not select.select([self._descriptor], [], [], WAIT_S)[0]:
                yield Batch([])
                continue
            chunk = os.read(self._descriptor, CHUNK)
            arrived = time.monotonic()
            yield Batch(lines.rows(chunk), arrived=arrived)


class FileSource:
    """Lines of a file; with `follow`, also those written to it later, and those of a file that takes its place.

    Raises `InputError` where it cannot be read.
    """

    def __init__(self, path: str | os.PathLike[str], parser: LineParser, *, follow: bool = False) -> None:
        self.path, self.parser, self.follow = Path(path), parser, follow
        self._file: BinaryIO | None = None
        self._opened().close()

    @property
    def identity(self) -> str | None:
        """The path and the file behind it: a file that takes its place is another."""
        found = os.stat(self.path) if self._file is None else os.fstat(self._file.fileno())
        return f"{self.path.absolute()} {found.st_ino}"

    def batches(self, stop: Event, start: int | None = None) -> Generator[Batch, None, None]:
        """As the contract; `start` in bytes."""
        self._file = file = self._opened()
        try:
            lines = self._begun(file, start)
            while not stop.is_set():
                chunk, arrived = file.read(CHUNK), time.monotonic()
                replaced = not chunk and self.follow and self._replaced(file, lines.position)
                if chunk or replaced or not self.follow:
                    yield Batch(lines.rows(chunk), lines.position, arrived)
                else:
                    yield Batch([], lines.position)
                    time.sleep(POLL_S)
                if replaced:
                    file.close()
                    self._file = file = self._opened()
                    self.parser.header = None
                    lines = _Lines(self.parser)
                elif not chunk and not self.follow:
                    return
        finally:
            file.close()
            self._file = None

    def _begun(self, file: BinaryIO, start: int | None) -> _Lines:
        """From `start` on; from the beginning where the file has become shorter."""
        if start is not None and start <= os.fstat(file.fileno()).st_size:
            # a CSV's header, or what shows that it is JSON, is of every run
            before = self.parser.counts.to_dict()
            while self.parser.header is None and file.tell() < start and (line := file.readline(LONGEST)):
                self.parser.row(line)
            self.parser.counts.load(before)
            if file.tell() <= start:
                file.seek(start)
                return _Lines(self.parser, start)
        self.parser.header = None
        file.seek(0)
        return _Lines(self.parser)

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


ROWS = 500
"""Rows of a batch where nothing is waited for."""
TICK_S = 0.01
"""How often rows are looked for where they come at their own pace [s]."""


class PlayedLog:
    """The rows of a recording (a ROS 2 bag, MCAP, whatever `Log.read` reads) as a live source.

    They are of one car called `car`, by default as the file. `rate`: how many times faster than recorded; None is as
    fast as they are taken. Raises `InputError` as `Log.read`, for a log without a command, and for a rate that is not
    positive.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        *,
        map: Pairs = None,
        unit: Pairs = None,
        rate: float | None = None,
        car: str | None = None,
    ) -> None:
        if rate is not None and not (np.isfinite(rate) and rate > 0):
            raise InputError(f"rate: found {rate:g}, needs a finite number above 0")
        log = Log.read(path, map=map, unit=unit)
        if log.accel_cmd is None:
            raise no_command(log, "; T_L and K_L need the demanded acceleration")
        self.rate = rate
        self.car = Path(path).stem if car is None else car
        signals = [(name, getattr(log, name)) for name in SIGNALS]
        self._signals = {name: values for name, values in signals if values is not None}
        if bool(log.engaged.all()):
            self._signals.pop("engaged")
        # a segment's clock may start anew, as a car's may
        self._time = np.asarray(log.time, np.float64)
        self._elapsed = np.asarray(log.elapsed, np.float64)
        self.identity = f"{Path(path).absolute()} {fingerprint([self._time, self._signals])}"

    def batches(self, stop: Event, start: int | None = None) -> Generator[Batch, None, None]:
        """As the contract; `start` in rows."""
        row, rows = start or 0, len(self._time)
        begun, first = time.monotonic(), float(self._elapsed[min(row, rows - 1)])
        while row < rows and not stop.is_set():
            end = min(row + ROWS, rows)
            if self.rate is not None:
                now = first + (time.monotonic() - begun) * self.rate
                end = min(end, max(row, int(np.searchsorted(self._elapsed, now, side="right"))))
            yield Batch(self._rows(row, end), end)
            if end == row:
                time.sleep(TICK_S)
            row = end

    def _rows(self, first: int, end: int) -> list[Row]:
        part = {name: values[first:end].tolist() for name, values in self._signals.items()}
        times = self._time[first:end].tolist()
        return [Row(self.car, t, {name: values[i] for name, values in part.items()}) for i, t in enumerate(times)]
