"""ROS bags by rosbags, without ROS: version 1, and version 2 as SQLite, MCAP or a folder of either."""

from __future__ import annotations

import math
import os
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from operator import attrgetter
from pathlib import Path
from typing import Any

from avtorch.errors import InputError, listed, printable, quoted
from avtorch.io.formats import kinds
from avtorch.io.formats.kinds import Kind, guarded, library
from avtorch.io.formats.listed import Recording, Row, topic_recording
from avtorch.io.opening import place

_NEED = "an undamaged ROS bag with its index (`rosbag reindex` or `mcap recover` mends one that was cut off)"
_NANO = 10**9
_TIME, _DURATION = "builtin_interfaces/msg/Time", "builtin_interfaces/msg/Duration"
_NUMBERS = frozenset(
    (
        "bool", "byte", "char", "octet", "float32", "float64",
        "int8", "int16", "int32", "int64", "uint8", "uint16", "uint32", "uint64",
    )
)  # fmt: skip
_DEEPEST = 8
_MOST = 2000  # fields of one type: types within types may multiply
_BASE, _NAME = 1, 2  # kinds of a field: a number or text, another type; the rest are arrays


@dataclass(frozen=True)
class _Topic:
    """One topic: its connections, its type, and the stores that know the type, the likeliest first."""

    connections: tuple[Any, ...]
    type: str
    stores: tuple[Any, ...]
    stamp: str | None
    fields: tuple[str, ...]


def open_file(path: str | os.PathLike[str], kind: Kind) -> Recording:
    """Open a bag and list its fields from the definitions of its types, without reading a message.

    Channels are ``/topic/field/sub``, every numeric field but arrays; their time is the stamp of the message's header
    or its own [s since 1970], and the time of recording where it has none or where it is not set. Types that the bag
    does not define are those of ROS 2 itself, of Autoware, and of Ackermann drives. Raises InputError.
    """
    source = place(path)
    typesys = library("rosbags.typesys", source, kind)
    with guarded(source, _NEED):
        reader = _opened(Path(path), kind, source)
        topics, left = _topics(reader.connections, typesys)
    fields: dict[str, tuple[str, str]] = {}
    for name, topic in topics.items():
        for field in topic.fields:
            fields.setdefault(f"{name}/{field.replace('.', '/')}", (name, field))
    if not fields and left:
        types = listed(sorted({printable(c.msgtype) for c in reader.connections}))
        raise InputError(f"{source}: no message type is known: {types}; definitions in the bag are needed")

    def decoded(store: Any, raw: bytes, type_: str) -> Any:
        return store.deserialize_ros1(raw, type_) if kind is kinds.ROS1 else store.deserialize_cdr(raw, type_)

    def fitting(topic: _Topic, raw: bytes) -> Any:
        """The store whose layout of the type a message has."""
        for store in topic.stores[:-1]:
            try:
                decoded(store, raw, topic.type)
            except Exception:  # whatever a wrong layout runs into
                continue
            return store
        return topic.stores[-1]

    def messages(paths: Mapping[str, Sequence[str]]) -> Iterator[Row]:
        by_connection = {(c.topic, c.id): name for name in paths for c in topics[name].connections}
        fields = {topic: attrgetter(own[0], *own) for topic, own in paths.items()}  # a tuple for one field, too
        stores: dict[str, Any] = {}  # of the types, found by a topic's first message
        count, name = Counter[str](), ""

        def where() -> str:
            return f"{source}: topic {quoted(name, 80)}: message {count[name]}" if name else source

        with guarded(where, _NEED):
            for connection, at, raw in reader.messages([c for topic in paths for c in topics[topic].connections]):
                name = by_connection[connection.topic, connection.id]
                count[name] += 1
                if name not in stores:
                    stores[name] = fitting(topics[name], raw)
                message = decoded(stores[name], raw, topics[name].type)
                yield name, tuple(map(float, fields[name](message)[1:])), at / _NANO, _stamp_of(message, topics[name])

    remarks = [f"topics left out, their type is unknown or differs: {listed(left)}"] if left else []
    return topic_recording(source, kind.words, fields, remarks, messages)


def _opened(file: Path, kind: Kind, source: str) -> Any:
    """An opened reader of rosbags, with `connections` and `messages`."""
    if kind is kinds.ROS1:
        reader = library("rosbags.rosbag1", source, kind).Reader(file)
    else:
        storage = {kinds.ROS2_FOLDER: "dir", kinds.ROS2_SQLITE: ".db3", kinds.ROS2_MCAP: ".mcap"}[kind]
        if kind is kinds.ROS2_SQLITE and any(mark in str(file) for mark in "?#%"):  # rosbags makes an address of it
            raise InputError(f"{source}: has one of ? # % in its path; a path without is needed for SQLite")
        reader = library("rosbags.rosbag2", source, kind).Reader.STORAGE_PLUGINS[storage](file)
    reader.open()
    return reader


def _stamp_of(message: Any, topic: _Topic) -> float:
    """The stamp of a message [s], NaN where its type has none."""
    if topic.stamp is None:
        return math.nan
    moment = attrgetter(topic.stamp)(message)
    return (moment.sec * _NANO + moment.nanosec) / _NANO


def _stores_of(typesys: Any) -> Callable[[str, Any], tuple[Any, ...]]:
    """By a type and its definition the stores that know it: one for each definition in the bag, and those for types
    that it does not define."""

    @cache
    def stores(type_: str, definition: Any) -> tuple[Any, ...]:
        return (defined(type_, definition),) if definition.data else undefined()

    def defined(type_: str, definition: Any) -> Any:
        if definition.format.name == "MSG":
            types = typesys.get_types_from_msg(definition.data, type_)
        else:
            types = {}
            for part in definition.data.split("=" * 80 + "\n"):
                if part.strip():
                    types |= typesys.get_types_from_idl(part.partition("\n")[2] if part.startswith("IDL:") else part)
        store = typesys.get_typestore(typesys.Stores.EMPTY)
        store.register(types)
        return store

    @cache
    def undefined() -> tuple[Any, ...]:
        found = []
        for newer in _LAYOUTS:
            store = typesys.get_typestore(typesys.Stores.LATEST)
            types = {}
            for name, text in {**_LAYOUTS[0], **newer}.items():
                if name not in store.fielddefs:
                    types |= typesys.get_types_from_msg(text, name)
            store.register(types)
            found.append(store)
        return tuple(found)

    return stores


def _topics(connections: Sequence[Any], typesys: Any) -> tuple[dict[str, _Topic], list[str]]:
    """Topics by name, and the names of those whose type is not known or is not one and the same."""
    stores_of = _stores_of(typesys)
    by_name: dict[str, list[Any]] = {}
    for connection in connections:
        by_name.setdefault(printable(connection.topic), []).append(connection)
    topics: dict[str, _Topic] = {}
    left = []
    for name, own in by_name.items():
        first = own[0]
        try:
            if not all((c.msgtype, c.msgdef) == (first.msgtype, first.msgdef) for c in own):
                raise ValueError("messages of several types")
            if not all(getattr(c.ext, "serialization_format", "cdr") in ("cdr", "") for c in own):
                raise ValueError("messages that are not CDR")
            stores = stores_of(first.msgtype, first.msgdef)
            definitions = stores[0].fielddefs
            stamp, fields = _stamp_field(definitions, first.msgtype), numeric_fields(definitions, first.msgtype)
        except Exception:  # a definition that cannot be parsed leaves out its topic, not the bag
            left.append(name)
            continue
        topics[name] = _Topic(tuple(own), first.msgtype, stores, stamp, tuple(fields))
    return topics, left


def numeric_fields(definitions: Mapping[str, Any], type_: str, before: Sequence[str] = ()) -> list[str]:
    """Paths such as ``twist.linear.x`` of the numeric fields, without arrays, stamps and durations; 2000 at most.

    Raises KeyError for a type that is not defined.
    """
    found: list[str] = []
    for name, (kind, what) in definitions[type_][1]:
        path = (*before, name)
        if kind == _BASE and what[0] in _NUMBERS:
            found.append(".".join(path))
        elif kind == _NAME and what not in (_TIME, _DURATION) and len(path) < _DEEPEST:
            found += numeric_fields(definitions, what, path)
        if len(found) >= _MOST:
            return found[:_MOST]
    return found


def _stamp_field(definitions: Mapping[str, Any], type_: str) -> str | None:
    """The path of the stamp that dates a message: its header's, or its own; None where it has neither."""
    fields = dict(definitions[type_][1])
    if fields.get("stamp") == (_NAME, _TIME):
        return "stamp"
    kind, what = fields.get("header", (None, None))
    if kind == _NAME and dict(definitions[what][1]).get("stamp") == (_NAME, _TIME):
        return "header.stamp"
    return None


# Message types of Autoware and of Ackermann drives, for bags that do not bring their definitions along: ROS 2 recorded
# to SQLite without them until Iron. Fields and their order are all that the bytes need. Where a type has changed, the
# layouts stand one after the other, the newest first; a message fits one of them only.
_SENT = "builtin_interfaces/Time stamp\n"
_TIMES = _SENT + "builtin_interfaces/Time control_time\n"
_HEADER = "std_msgs/Header header\n"
_STEERING = "float32 steering_tire_angle\nfloat32 steering_tire_rotation_rate\n"
_LATERAL = _STEERING + "bool is_defined_steering_tire_rotation_rate\n"
_LONGITUDINAL = (
    "float32 velocity\nfloat32 acceleration\nfloat32 jerk\nbool is_defined_acceleration\nbool is_defined_jerk\n"
)
_VELOCITY = _HEADER + "float32 longitudinal_velocity\nfloat32 lateral_velocity\nfloat32 heading_rate\n"
_CONTROL = "Lateral lateral\nLongitudinal longitudinal\n"
_ACKERMANN = (
    "float32 steering_angle\nfloat32 steering_angle_velocity\nfloat32 speed\nfloat32 acceleration\nfloat32 jerk\n"
)

_LAYOUTS: tuple[Mapping[str, str], ...] = (
    {
        "autoware_control_msgs/msg/Control": _TIMES + _CONTROL,
        "autoware_control_msgs/msg/Lateral": _TIMES + _LATERAL,
        "autoware_control_msgs/msg/Longitudinal": _TIMES + _LONGITUDINAL,
        "autoware_vehicle_msgs/msg/VelocityReport": _VELOCITY,
        "autoware_vehicle_msgs/msg/ControlModeReport": _SENT + "uint8 mode\n",
        "autoware_vehicle_msgs/msg/SteeringReport": _SENT + "float32 steering_tire_angle\n",
        "autoware_vehicle_msgs/msg/GearReport": _SENT + "uint8 report\n",
        "autoware_auto_control_msgs/msg/AckermannControlCommand": (
            _SENT + "AckermannLateralCommand lateral\nLongitudinalCommand longitudinal\n"
        ),
        "autoware_auto_control_msgs/msg/AckermannLateralCommand": _SENT + _STEERING,
        "autoware_auto_control_msgs/msg/LongitudinalCommand": (
            _SENT + "float32 speed\nfloat32 acceleration\nfloat32 jerk\n"
        ),
        "autoware_auto_vehicle_msgs/msg/VelocityReport": _VELOCITY,
        "autoware_auto_vehicle_msgs/msg/ControlModeReport": _SENT + "uint8 mode\n",
        "autoware_auto_vehicle_msgs/msg/SteeringReport": _SENT + "float32 steering_tire_angle\n",
        "ackermann_msgs/msg/AckermannDrive": _ACKERMANN,
        "ackermann_msgs/msg/AckermannDriveStamped": _HEADER + "AckermannDrive drive\n",
    },
    {
        "autoware_control_msgs/msg/Control": _SENT + _CONTROL,
        "autoware_control_msgs/msg/Lateral": _SENT + _LATERAL,
        "autoware_control_msgs/msg/Longitudinal": _SENT + _LONGITUDINAL,
    },
)
"""By type: the fields, one a line, as in a ``.msg`` file. A later entry replaces those of the first for its types."""
