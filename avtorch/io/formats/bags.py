"""ROS bags by rosbags, without ROS: version 1, and version 2 as SQLite, MCAP or a folder of either."""

from __future__ import annotations

import os
import weakref
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path
from typing import Any

from avtorch.errors import InputError, listed, printable, quoted
from avtorch.io.formats import kinds
from avtorch.io.formats.bag_fields import numeric_fields, stamp_field
from avtorch.io.formats.bag_opening import open_bag
from avtorch.io.formats.bag_types import LAYOUTS
from avtorch.io.formats.kinds import Kind
from avtorch.io.formats.library import guarded, library
from avtorch.io.formats.listed import refuse_cells
from avtorch.io.formats.topics import Piece, TopicRecording
from avtorch.io.opening import place
from avtorch.io.size import MOST_CELLS, MOST_COLUMNS

_NEED = "an undamaged ROS bag with its index (`rosbag reindex` or `mcap recover` mends one that was cut off)"
_NANO = 10**9


@dataclass(frozen=True)
class Topic:
    """One topic: its connections, its type, and the stores that know the type, the likeliest first."""

    connections: tuple[Any, ...]
    type: str
    stores: tuple[Any, ...]
    stamp: str | None

    @property
    def count(self) -> int:
        """Messages as the bag's index says, where it says a number; a folder's metadata may be damaged."""
        told = (connection.msgcount for connection in self.connections)
        return sum(max(0, n) for n in told if isinstance(n, int))


class BagRecording(TopicRecording):
    """A bag. Channels are ``/topic/field/sub``, every numeric field but arrays; their time is the stamp of the
    message's header or its own [s since 1970], and the time of recording where it has none or where it is not set."""

    _topics: Mapping[str, Topic]

    def __init__(
        self,
        source: str,
        kind: Kind,
        reader: Any,
        topics: Mapping[str, Topic],
        fields: Mapping[str, tuple[str, str]],
        remarks: Sequence[str],
    ) -> None:
        super().__init__(source, kind.words, topics, fields, remarks)
        self._reader = reader
        self._one = kind is kinds.ROS1

    def _collect(self, paths: Mapping[str, Sequence[str]]) -> dict[str, Piece]:
        pieces = {name: Piece(len(own)) for name, own in paths.items()}
        takers = {name: _taker(self._topics[name], own, pieces[name]) for name, own in paths.items()}
        stores: dict[str, Any] = {}  # of the types, found by a topic's first message
        by_connection = {(c.topic, c.id): name for name in paths for c in self._topics[name].connections}
        name, samples = "", 0

        def where() -> str:
            at = f": topic {quoted(name, 80)}: message {len(pieces[name].logged) + 1}" if name else ""
            return f"{self.source}{at}"

        with guarded(where, _NEED):
            connections = [c for name in paths for c in self._topics[name].connections]
            for connection, at, raw in self._reader.messages(connections):
                name = by_connection[connection.topic, connection.id]
                if name not in stores:
                    stores[name] = self._fitting(self._topics[name], raw)
                takers[name](self._decoded(stores[name], raw, self._topics[name].type), at)
                samples += len(paths[name])
                if samples > MOST_CELLS:
                    refuse_cells(self.source, samples)
        return pieces

    def _fitting(self, topic: Topic, raw: bytes) -> Any:
        for store in topic.stores[:-1]:
            try:
                self._decoded(store, raw, topic.type)
            except Exception:  # whatever a wrong layout runs into
                continue
            return store
        return topic.stores[-1]

    def _decoded(self, store: Any, raw: bytes, type_: str) -> Any:
        return store.deserialize_ros1(raw, type_) if self._one else store.deserialize_cdr(raw, type_)


def _taker(topic: Topic, paths: Sequence[str], piece: Piece) -> Callable[[Any, int], None]:
    """Puts a message that was recorded at a time [ns] into the piece."""
    fields = attrgetter(paths[0], *paths)  # a tuple for one field, too
    stamp = attrgetter(topic.stamp) if topic.stamp else None

    def take(message: Any, at: int) -> None:
        moment = None if stamp is None else stamp(message)
        stamped = None if moment is None else (moment.sec * _NANO + moment.nanosec) / _NANO
        piece.take(fields(message)[1:], at / _NANO, stamped)

    return take


def open_file(path: str | os.PathLike[str], kind: Kind) -> BagRecording:
    """Open a bag and list its fields from the definitions of its types, without reading a message.

    Types that the bag does not define are those of ROS 2 itself, of Autoware, and of Ackermann drives. Raises
    InputError.
    """
    source = place(path)
    typesys = library("rosbags.typesys", source, kind)
    with guarded(source, _NEED):
        reader = open_bag(Path(path), kind, source)
    try:
        with guarded(source, _NEED):
            known = _Known(typesys)
            topics, left = _topics(reader.connections, known)
        fields: dict[str, tuple[str, str]] = {}
        remarks = [f"topics left out, their type is unknown or differs: {listed(left)}"] if left else []
        for name, topic in topics.items():
            with guarded(f"{source}: topic {quoted(name, 80)}", _NEED):
                for field in numeric_fields(topic.stores[0].fielddefs, topic.type):
                    fields.setdefault(f"{name}/{field.replace('.', '/')}", (name, field))
            if len(fields) > MOST_COLUMNS:
                remarks.append(f"only the first {MOST_COLUMNS:,} fields are listed")
                fields = dict(list(fields.items())[:MOST_COLUMNS])
                break
        if not fields and left:
            types = listed(sorted({printable(c.msgtype) for c in reader.connections}))
            raise InputError(f"{source}: no message type is known: {types}; definitions in the bag are needed")
        recording = BagRecording(source, kind, reader, topics, fields, remarks)
    except BaseException:
        reader.close()
        raise
    weakref.finalize(recording, reader.close)
    return recording


class _Known:
    """Stores of types: one for each definition in the bag, and those for types that it does not define."""

    def __init__(self, typesys: Any) -> None:
        self._typesys = typesys
        self._own: dict[tuple[str, Any], tuple[Any, ...]] = {}
        self._others: tuple[Any, ...] = ()

    def stores(self, connection: Any) -> tuple[Any, ...]:
        if not connection.msgdef.data:
            return self._without_definition()
        key = (connection.msgtype, connection.msgdef)
        if key not in self._own:
            self._own[key] = (self._defined(connection),)
        return self._own[key]

    def _defined(self, connection: Any) -> Any:
        typesys, text = self._typesys, connection.msgdef.data
        if connection.msgdef.format.name == "MSG":
            types = typesys.get_types_from_msg(text, connection.msgtype)
        else:
            types = {}
            for part in text.split("=" * 80 + "\n"):
                if part.strip():
                    types |= typesys.get_types_from_idl(part.partition("\n")[2] if part.startswith("IDL:") else part)
        store = typesys.get_typestore(typesys.Stores.EMPTY)
        store.register(types)
        return store

    def _without_definition(self) -> tuple[Any, ...]:
        if not self._others:
            stores = []
            for newer in LAYOUTS:
                store = self._typesys.get_typestore(self._typesys.Stores.LATEST)
                types = {}
                for name, text in {**LAYOUTS[0], **newer}.items():
                    if name not in store.fielddefs:
                        types |= self._typesys.get_types_from_msg(text, name)
                store.register(types)
                stores.append(store)
            self._others = tuple(stores)
        return self._others


def _topics(connections: Sequence[Any], known: _Known) -> tuple[dict[str, Topic], list[str]]:
    """Topics by name, and the names of those whose type is not known or is not one and the same."""
    by_name: dict[str, list[Any]] = {}
    for connection in connections:
        by_name.setdefault(printable(connection.topic), []).append(connection)
    topics: dict[str, Topic] = {}
    left = []
    for name, own in by_name.items():
        first = own[0]
        same = all((c.msgtype, c.msgdef) == (first.msgtype, first.msgdef) for c in own)
        try:
            stores = known.stores(first)
            fits = same and all(getattr(c.ext, "serialization_format", "cdr") in ("cdr", "") for c in own)
            stamp = stamp_field(stores[0].fielddefs, first.msgtype)
            numeric_fields(stores[0].fielddefs, first.msgtype)
        except Exception:  # a definition that cannot be parsed leaves out its topic, not the bag
            fits, stores, stamp = False, (), None
        if fits:
            topics[name] = Topic(tuple(own), first.msgtype, stores, stamp)
        else:
            left.append(name)
    return topics, left
