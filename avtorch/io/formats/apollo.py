"""Apollo's cyber records by cyber-record: the record brings the definitions of its messages, so no Apollo is needed."""

from __future__ import annotations

import os
import weakref
from array import array
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from avtorch.arrays import FloatArray
from avtorch.errors import InputError, listed, printable, quoted
from avtorch.io.formats.kinds import Kind
from avtorch.io.formats.library import guarded, library
from avtorch.io.formats.listed import Listed, refuse_cells
from avtorch.io.formats.opened import opened
from avtorch.io.formats.protobuf_fields import Path, numeric_fields, stamp_field, value_at
from avtorch.io.opening import place
from avtorch.io.recording import Channel
from avtorch.io.size import MOST_CELLS, MOST_COLUMNS

_NEED = "an undamaged Apollo record, closed by its recorder or by `cyber_recorder recover`,"


@dataclass(frozen=True)
class _Topic:
    raw: str
    count: int
    stamp: Path | None


@dataclass
class _Piece:
    """What is read of one topic: columns of its fields, the times of recording, and the stamps, 0 where none is set."""

    topic: _Topic
    paths: Sequence[Path]
    columns: list[array] = field(default_factory=list)
    logged: array = field(default_factory=lambda: array("d"))
    stamped: array = field(default_factory=lambda: array("d"))

    def __post_init__(self) -> None:
        self.columns = [array("d") for _ in self.paths]

    def take(self, message: Any, at: int) -> None:
        """The fields of a message that was recorded `at` [ns]."""
        for column, path in zip(self.columns, self.paths, strict=True):
            column.append(value_at(message, path))
        self.stamped.append(0.0 if self.topic.stamp is None else value_at(message, self.topic.stamp))
        self.logged.append(at / 1e9)

    def time(self) -> FloatArray:
        stamped = np.array(self.stamped, dtype=np.float64)
        return stamped if len(stamped) and (stamped > 0).all() else np.array(self.logged, dtype=np.float64)


class ApolloRecording(Listed):
    """A record. Channels are ``/topic/field/sub``, every number that is not repeated, NaN where a message has not set
    it; their time is the stamp of the message's header [s since 1970], and that of recording where it has none."""

    def __init__(
        self,
        source: str,
        kind: Kind,
        record: Any,
        topics: Mapping[str, _Topic],
        fields: Mapping[str, tuple[str, Path]],
        remarks: Sequence[str],
    ) -> None:
        super().__init__(source, kind.words, fields, {}, remarks)
        self._record, self._topics, self._fields = record, topics, fields

    def _read(self, names: tuple[str, ...]) -> dict[str, Channel]:
        asked: dict[str, list[str]] = {}
        for name in names:
            asked.setdefault(self._fields[name][0], []).append(name)
        refuse_cells(self.source, sum(self._topics[topic].count * len(own) for topic, own in asked.items()))
        pieces = {t: _Piece(self._topics[t], [self._fields[c][1] for c in own]) for t, own in asked.items()}
        self._collect({piece.topic.raw: piece for piece in pieces.values()})
        found: dict[str, Channel] = {}
        for topic, piece in pieces.items():
            time = piece.time()
            for name, column in zip(asked[topic], piece.columns, strict=True):
                found[name] = Channel(name, time, np.array(column, dtype=np.float64))
        return {name: found[name] for name in names}

    def _collect(self, pieces: Mapping[str, _Piece]) -> None:
        """One pass over the messages of the topics of `pieces`."""
        samples, topic = 0, ""

        def where() -> str:
            return f"{self.source}: topic {quoted(printable(topic), 80)}" if topic else self.source

        with guarded(where, _NEED):
            for topic, message, at in self._record.read_messages(set(pieces)):
                piece = pieces[topic]
                piece.take(message, at)
                samples += len(piece.columns)
                if samples > MOST_CELLS:
                    refuse_cells(self.source, samples)


def open_file(path: str | os.PathLike[str], kind: Kind) -> ApolloRecording:
    """Open a record and list the numbers of its topics by the definitions it holds, without reading a message.

    Topics without a definition are left out. Raises InputError, also for a record that was not closed: its index tells
    where the messages are.
    """
    source = place(path)
    opened(path, need="an Apollo record").close()
    cyber = library("cyber_record.record", source, kind)
    with guarded(source, _NEED):
        record = cyber.Record(os.fspath(path))
    try:
        with guarded(source, _NEED):
            if record._compression is not cyber.Compression.NONE:
                raise InputError(f"{source}: is {kind.words} with compressed chunks; one without compression is needed")
            topics, fields, left = _listing(record)
        remarks = [f"topics left out, the record does not define their type: {listed(left)}"] if left else []
        if len(fields) > MOST_COLUMNS:
            remarks.append(f"only the first {MOST_COLUMNS:,} fields are listed")
            fields = dict(list(fields.items())[:MOST_COLUMNS])
        recording = ApolloRecording(source, kind, record, topics, fields, remarks)
    except BaseException:
        record.close()
        raise
    weakref.finalize(recording, record.close)
    return recording


def _listing(record: Any) -> tuple[dict[str, _Topic], dict[str, tuple[str, Path]], list[str]]:
    """Topics and fields by name, and the names of topics without a definition."""
    topics: dict[str, _Topic] = {}
    fields: dict[str, tuple[str, Path]] = {}
    left = []
    for channel in record.get_channel_cache():
        name = printable(channel.name)
        message = record._reader.message_type_pool.get(channel.name)
        if message is None:
            left.append(name)
            continue
        topics[name] = _Topic(channel.name, int(channel.message_number), stamp_field(message.DESCRIPTOR))
        for path in numeric_fields(message.DESCRIPTOR):
            fields.setdefault(f"{name}/{'/'.join(path)}", (name, path))
    return topics, fields, left
