"""Apollo's cyber records by cyber-record: the record brings the definitions of its messages, so no Apollo is needed."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from avtorch.errors import InputError, listed, printable, quoted
from avtorch.io.formats.kinds import Kind, guarded, library
from avtorch.io.formats.listed import Recording, Row, topic_recording
from avtorch.io.opening import place

_NEED = "an undamaged Apollo record, closed by its recorder or by `cyber_recorder recover`,"
_DEEPEST = 8
_MOST = 2000  # fields of one type: types within types may multiply

Path = tuple[str, ...]


def open_file(path: str | os.PathLike[str], kind: Kind) -> Recording:
    """Open a record and list the numbers of its topics by the definitions it holds, without reading a message.

    Channels are ``/topic/field/sub``, every number that is not repeated, NaN where a message has not set it; their time
    is the stamp of the message's header [s since 1970], and that of recording where it has none. Topics without a
    definition are left out. Raises InputError, also for a record that was not closed: its index tells where the
    messages are.
    """
    source = place(path)
    cyber = library("cyber_record.record", source, kind)
    topics: dict[str, tuple[str, Path | None]] = {}  # by name, the name as recorded and where the stamp is
    fields: dict[str, tuple[str, Path]] = {}
    left = []
    with guarded(source, _NEED):
        record = cyber.Record(os.fspath(path))
        if record._compression is not cyber.Compression.NONE:
            raise InputError(f"{source}: is {kind.words} with compressed chunks; one without compression is needed")
        for channel in record.get_channel_cache():
            name = printable(channel.name)
            message = record._reader.message_type_pool.get(channel.name)
            if message is None:
                left.append(name)
                continue
            topics[name] = channel.name, _stamp_field(message.DESCRIPTOR)
            for field in _numeric_fields(message.DESCRIPTOR):
                fields.setdefault(f"{name}/{'/'.join(field)}", (name, field))

    def messages(paths: Mapping[str, Sequence[Path]]) -> Iterator[Row]:
        by_raw = {topics[name][0]: name for name in paths}
        topic = ""

        def where() -> str:
            return f"{source}: topic {quoted(printable(topic), 80)}" if topic else source

        with guarded(where, _NEED):
            for topic, message, at in record.read_messages(set(by_raw)):
                name = by_raw[topic]
                stamp = topics[name][1]
                numbers = [_value_at(message, path) for path in paths[name]]
                yield name, numbers, at / 1e9, math.nan if stamp is None else _value_at(message, stamp)

    remarks = [f"topics left out, the record does not define their type: {listed(left)}"] if left else []
    return topic_recording(source, kind.words, fields, remarks, messages)


def _numeric_fields(descriptor: Any, before: Path = ()) -> list[Path]:
    """Paths of all numbers, states and enums included, without repeated fields; 2000 at most."""
    found: list[Path] = []
    for one in descriptor.fields:
        if one.label == one.LABEL_REPEATED:
            continue
        path = (*before, one.name)
        if one.cpp_type == one.CPPTYPE_MESSAGE:
            found += _numeric_fields(one.message_type, path) if len(path) < _DEEPEST else []
        elif one.cpp_type != one.CPPTYPE_STRING:
            found.append(path)
        if len(found) >= _MOST:
            return found[:_MOST]
    return found


def _stamp_field(descriptor: Any) -> Path | None:
    """Where Apollo's header holds the moment of a message [s]; None for a type without such a header."""
    header = descriptor.fields_by_name.get("header")
    if header is None or header.message_type is None:
        return None
    return ("header", "timestamp_sec") if "timestamp_sec" in header.message_type.fields_by_name else None


def _value_at(message: Any, path: Path) -> float:
    """The number at a path, NaN where the message has not set it: a default is no measurement."""
    for name in path:
        one = message.DESCRIPTOR.fields_by_name[name]
        if one.has_presence and not message.HasField(name):
            return math.nan
        message = getattr(message, name)
    return float(message)
