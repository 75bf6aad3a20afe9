"""Apollo's cyber records by cyber-record: the record brings the definitions of its messages, so no Apollo is needed."""

from __future__ import annotations

import os
import weakref
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from avtorch.errors import InputError, listed, printable, quoted
from avtorch.io.formats.kinds import Kind
from avtorch.io.formats.library import guarded, library
from avtorch.io.formats.listed import refuse_cells
from avtorch.io.formats.opened import opened
from avtorch.io.formats.protobuf_fields import Path, numeric_fields, stamp_field, value_at
from avtorch.io.formats.topics import Piece, TopicRecording
from avtorch.io.opening import place
from avtorch.io.size import MOST_CELLS, MOST_COLUMNS

_NEED = "an undamaged Apollo record, closed by its recorder or by `cyber_recorder recover`,"


@dataclass(frozen=True)
class _Topic:
    raw: str
    count: int
    stamp: Path | None


class ApolloRecording(TopicRecording):
    """A record. Channels are ``/topic/field/sub``, every number that is not repeated, NaN where a message has not set
    it; their time is the stamp of the message's header [s since 1970], and that of recording where it has none."""

    _topics: Mapping[str, _Topic]

    def __init__(
        self,
        source: str,
        kind: Kind,
        record: Any,
        topics: Mapping[str, _Topic],
        fields: Mapping[str, tuple[str, Path]],
        remarks: Sequence[str],
    ) -> None:
        super().__init__(source, kind.words, topics, fields, remarks)
        self._record = record

    def _collect(self, paths: Mapping[str, Sequence[Path]]) -> dict[str, Piece]:
        pieces = {name: Piece(len(own)) for name, own in paths.items()}
        by_raw = {self._topics[name].raw: name for name in paths}
        samples, topic = 0, ""

        def where() -> str:
            return f"{self.source}: topic {quoted(printable(topic), 80)}" if topic else self.source

        with guarded(where, _NEED):
            for topic, message, at in self._record.read_messages(set(by_raw)):
                name = by_raw[topic]
                stamp = self._topics[name].stamp
                row = [value_at(message, path) for path in paths[name]]
                pieces[name].take(row, at / 1e9, None if stamp is None else value_at(message, stamp))
                samples += len(row)
                if samples > MOST_CELLS:
                    refuse_cells(self.source, samples)
        return pieces


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
