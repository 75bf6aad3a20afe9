"""CAN logs by python-can (BLF, ASC, candump), decoded by cantools with DBC databases."""

from __future__ import annotations

import io
import os
from array import array
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from avtorch.errors import InputError, listed, quoted
from avtorch.io.formats import kinds
from avtorch.io.formats.can_database import Decoded, databases_of, messages_of
from avtorch.io.formats.kinds import Kind
from avtorch.io.formats.library import guarded, library, reason, silenced
from avtorch.io.formats.listed import Listed, refuse_cells
from avtorch.io.opening import place, read_regular
from avtorch.io.recording import Channel
from avtorch.io.size import MOST_BYTES

_NEED = "an undamaged BLF, ASC or candump log"

Identifier = tuple[int, bool]
Wanted = dict[Identifier, list[tuple[Decoded, dict[str, tuple[array, array]]]]]
"""By identifier, each message with the columns of time and values of its signals."""


class CanRecording(Listed):
    """A CAN log with its databases. Channels are ``Message.Signal``, of those messages that the log holds.

    Time is that of the log: from its start in ASC, since 1970 in BLF and candump. Values are physical, and those that
    the database names by texts are their numbers. A signal that its multiplexer leaves out of a frame has no sample
    there.
    """

    def __init__(
        self,
        source: str,
        kind: Kind,
        frames: _Frames,
        messages: Mapping[Identifier, Sequence[Decoded]],
        units: Mapping[str, str],
    ) -> None:
        present = {key: own for key, own in messages.items() if key in frames.bus}
        names = [name for own in present.values() for decoded in own for name in decoded.channels.values()]
        if not names:
            known = listed(f"{number:X}" for number, _ in messages)
            seen = listed(f"{number:X}" for number, _ in sorted(frames.bus))
            raise InputError(
                f"{source}: holds no message of its database; identifiers in the log: {seen}; in the database: {known}"
            )
        super().__init__(source, kind.words, names, {n: units[n] for n in names if n in units}, frames.remarks)
        self._frames, self._messages = frames, present

    def _read(self, names: tuple[str, ...]) -> dict[str, Channel]:
        asked = frozenset(names)
        wanted: Wanted = {}
        for key, own in self._messages.items():
            for decoded in own:
                columns = {s: (array("d"), array("d")) for s, n in decoded.channels.items() if n in asked}
                if columns:
                    wanted.setdefault(key, []).append((decoded, columns))
        with silenced():
            self._decode(wanted)
        found: dict[str, Channel] = {}
        for own in wanted.values():
            for decoded, columns in own:
                for signal, (time, column) in columns.items():
                    name = decoded.channels[signal]
                    found[name] = Channel(name, np.array(time, dtype=np.float64), np.array(column, dtype=np.float64))
        return {name: found[name] for name in names}

    def _decode(self, wanted: Wanted) -> None:
        """One pass over the log: samples of the wanted signals go to their columns."""
        samples = 0
        for number, key, frame in self._frames.read(frozenset(wanted)):
            for decoded, columns in wanted[key]:
                try:
                    values = decoded.message.decode(
                        bytes(frame.data), decode_choices=False, allow_truncated=True, decode_containers=False
                    )
                except Exception as fault:
                    name = next(iter(decoded.channels.values()))
                    raise InputError(
                        f"{self.source}: channel {quoted(name, 80)}: frame {number} at {frame.timestamp:.6f} s cannot "
                        f"be decoded ({reason(fault)}); the database that belongs to the log is needed"
                    ) from None
                for signal, (time, column) in columns.items():
                    if (value := values.get(signal)) is not None:
                        time.append(frame.timestamp)
                        column.append(value)
                        samples += 1
            if number % 4096 == 0:
                refuse_cells(self.source, samples)
        refuse_cells(self.source, samples)


class _Frames:
    """The frames of a log. `bus` tells for each identifier the bus on which it came first."""

    def __init__(self, path: Path, kind: Kind, source: str) -> None:
        self._path, self._kind, self._source = path, kind, source
        self.remarks: list[str] = []
        self._most: int | None = None
        self.bus: dict[Identifier, Any] = {}
        others: set[Identifier] = set()
        frames = 0
        with silenced():
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

    def read(self, wanted: frozenset[Identifier]) -> Iterator[tuple[int, Identifier, Any]]:
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
        raw = read_regular(self._path, most=MOST_BYTES, need=_NEED)
        if self._kind is kinds.BLF:
            stream = io.BytesIO(raw)
            return can.BLFReader(stream), stream
        end = raw.rfind(b"\n") + 1
        if raw[end:].strip():  # a number at the end may lack its last digits
            if self._most is None:
                self.remarks.append("the last line does not end; it is left out")
            raw = raw[:end]
        text = io.TextIOWrapper(io.BytesIO(raw), encoding="utf-8", errors="replace")
        return (can.ASCReader if self._kind is kinds.ASC else can.CanutilsLogReader)(text), text


def open_file(
    path: str | os.PathLike[str], kind: Kind, dbc: Sequence[str | os.PathLike[str]] | None = None
) -> CanRecording:
    """Open a CAN log with its databases; one pass over the log finds which messages it holds.

    Raises InputError for a log without a database or of another one, and for a damaged one; a log that is cut off is
    read as far as it goes, with a remark.
    """
    source = place(path)
    messages, units = messages_of(databases_of(Path(path), dbc, source), source, kind)
    return CanRecording(source, kind, _Frames(Path(path), kind, source), messages, units)
