"""CAN logs by python-can (BLF, ASC, candump), decoded by cantools with DBC databases."""

from __future__ import annotations

import io
import os
from array import array
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from avtorch.errors import InputError, listed, quoted
from avtorch.io.formats import kinds
from avtorch.io.formats.kinds import Kind, guarded, library, reason
from avtorch.io.formats.listed import Channel, Recording
from avtorch.io.opening import MOST_BYTES, place, read_regular

_NEED = "an undamaged BLF, ASC or candump log"
_NEED_DBC = "a DBC database"
_MOST_DBC = 2**24  # bytes of a DBC

Identifier = tuple[int, bool]


Message = tuple[Any, dict[str, str]]
"""One message of a database, and the channels of its signals by the signals' names."""


def open_file(path: str | os.PathLike[str], kind: Kind) -> Recording:
    """Open a CAN log with the database beside it; one pass over the log finds which messages it holds.

    Channels are ``Message.Signal``, of those messages that the log holds. Time is that of the log: from its start in
    ASC, since 1970 in BLF and candump. Values are physical, and those that the database names by texts are their
    numbers. A signal that its multiplexer leaves out of a frame has no sample there. Raises InputError for a log
    without a database or of another one, and for a damaged one; a log that is cut off is read as far as it goes, with
    a remark.
    """
    source = place(path)
    messages, units = _messages_of(_database_of(Path(path), source), source, kind)
    frames = _Frames(Path(path), kind, source)
    present = {key: own for key, own in messages.items() if key in frames.bus}
    names = [name for own in present.values() for _, channels in own for name in channels.values()]
    if not names:
        known = listed(f"{number:X}" for number, _ in messages)
        seen = listed(f"{number:X}" for number, _ in sorted(frames.bus))
        raise InputError(
            f"{source}: holds no message of its database; identifiers in the log: {seen}; in the database: {known}"
        )

    def load(asked: tuple[str, ...]) -> dict[str, Channel]:
        columns = {name: (array("d"), array("d")) for name in asked}
        wanted = {key: [m for m in own if not columns.keys().isdisjoint(m[1].values())] for key, own in present.items()}
        for number, key, frame in frames.read({key for key, own in wanted.items() if own}):
            for message, channels in wanted[key]:
                try:
                    values = message.decode(
                        bytes(frame.data), decode_choices=False, allow_truncated=True, decode_containers=False
                    )
                except Exception as fault:
                    name = next(iter(channels.values()))
                    raise InputError(
                        f"{source}: channel {quoted(name, 80)}: frame {number} at {frame.timestamp:.6f} s cannot "
                        f"be decoded ({reason(fault)}); the database that belongs to the log is needed"
                    ) from None
                for signal, value in values.items():
                    if value is not None and (column := columns.get(channels.get(signal, ""))) is not None:
                        column[0].append(frame.timestamp)
                        column[1].append(value)
        return {
            name: Channel(name, *(np.array(x, dtype=np.float64) for x in column)) for name, column in columns.items()
        }

    return Recording(source, kind.words, names, {n: units[n] for n in names if n in units}, frames.remarks, load)


class _Frames:
    """The frames of a log. `bus` tells for each identifier the bus on which it came first."""

    def __init__(self, path: Path, kind: Kind, source: str) -> None:
        self._kind, self._source = kind, source
        self.remarks: list[str] = []
        self._raw = read_regular(path, most=MOST_BYTES, need=_NEED)
        end = self._raw.rfind(b"\n") + 1
        if kind is not kinds.BLF and self._raw[end:].strip():  # a number at the end may lack its last digits
            self.remarks.append("the last line does not end; it is left out")
            self._raw = self._raw[:end]
        self._most: int | None = None
        self.bus: dict[Identifier, Any] = {}
        others: set[Identifier] = set()
        frames = 0
        for number, frame in self._all():
            frames = number
            key = (frame.arbitration_id, bool(frame.is_extended_id))
            if self.bus.setdefault(key, frame.channel) != frame.channel:
                others.add(key)
        if frames == 0:
            raise InputError(f"{source}: holds no frame; {_NEED} is needed")
        self._most = frames
        if others:
            names = listed(f"{n:X}" for n, _ in sorted(others))
            self.remarks.append(f"identifiers that several buses have are read from the bus of their first: {names}")

    def read(self, wanted: set[Identifier]) -> Iterator[tuple[int, Identifier, Any]]:
        """Number, identifier and frame, of those that are wanted."""
        for number, frame in self._all():
            key = (frame.arbitration_id, bool(frame.is_extended_id))
            if key in wanted and frame.channel == self.bus.get(key):
                yield number, key, frame

    def _all(self) -> Iterator[tuple[int, Any]]:
        """Frames of data with their numbers, from 1. Raises InputError at one that cannot be read, unless it is the
        last thing in the log."""
        number = 0
        with guarded(self._source, _NEED):
            reader, stream = self._reader()
            frames = iter(reader)
        while self._most is None or number < self._most:
            try:
                frame = next(frames, None)
            except Exception as fault:
                at_end = not stream.read(1)
                if number and (at_end or self._kind is kinds.BLF):
                    what = "cut off" if at_end else "damaged and no further read"
                    self.remarks.append(f"the log is {what} after frame {number}")
                    return
                raise InputError(
                    f"{self._source}: frame {number + 1} cannot be read ({reason(fault)}); {_NEED} is needed"
                ) from None
            if frame is None:
                return
            number += 1
            if not (frame.is_error_frame or frame.is_remote_frame):
                yield number, frame

    def _reader(self) -> tuple[Any, io.IOBase]:
        can = library("can.io", self._source, self._kind)
        stream = io.BytesIO(self._raw)
        if self._kind is kinds.BLF:
            return can.BLFReader(stream), stream
        text = io.TextIOWrapper(stream, encoding="utf-8", errors="replace")
        return (can.ASCReader if self._kind is kinds.ASC else can.CanutilsLogReader)(text), text


def _database_of(log: Path, source: str) -> Path:
    """The database that decodes `log`: the one beside it of its name, else the folder's only one.

    Raises InputError where there is none, or more than one and none of the log's name.
    """
    found = sorted(path for path in log.parent.iterdir() if path.suffix.lower() == ".dbc" and path.is_file())
    own = next((path for path in found if path.stem == log.stem), None)
    if own is not None or len(found) == 1:
        return own or found[0]
    what = f"its folder holds {len(found)}: {listed(path.name for path in found)}" if found else "found none beside it"
    raise InputError(
        f"{source}: is a CAN log, which a DBC database decodes; {what}; needs {log.stem}.dbc beside the log"
    )


def _messages_of(database: Path, source: str, kind: Kind) -> tuple[dict[Identifier, list[Message]], dict[str, str]]:
    """Messages by identifier and whether that is an extended one, and the units of their channels.

    A channel is ``Message.Signal``; where another message has that name already, the identifier stands between.
    Raises InputError.
    """
    cantools = library("cantools.database", source, kind)
    messages: dict[Identifier, list[Message]] = {}
    units: dict[str, str] = {}
    text = read_regular(database, most=_MOST_DBC, need=_NEED_DBC).decode("cp1252", errors="replace")
    with guarded(place(database), _NEED_DBC):
        taken: set[str] = set()
        for message in cantools.load_string(text, database_format="dbc", strict=False).messages:
            if message.is_container:
                continue
            twice = message.name in taken
            prefix = f"{message.name}.{message.frame_id:X}." if twice else f"{message.name}."
            taken.add(message.name)
            channels = {signal.name: prefix + signal.name for signal in message.signals}
            units |= {channels[signal.name]: signal.unit for signal in message.signals if signal.unit}
            key = (message.frame_id, bool(message.is_extended_frame))
            messages.setdefault(key, []).append((message, channels))
    if not messages:
        raise InputError(f"{place(database)}: defines no message; {_NEED_DBC} is needed")
    return messages, units
