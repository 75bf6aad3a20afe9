"""Bags: MCAP by its own authors' writer, SQLite by hand from rosbag2's schema, ROS 1 by rosbags' writer (no other is
installed without ROS)."""

from __future__ import annotations

import os
import re
import sqlite3
import struct
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from mcap_ros2.writer import Writer as McapWriter

from avtorch.errors import InputError
from avtorch.io.formats import apart, is_recording, open_recording

from .survival import open_here, refused, survives

COUNT = 80
START = 1_700_000_000
STAMPS = [START * 10**9 + i * 20_000_000 for i in range(COUNT)]  # ns
LATE = 3_000_007  # ns from a message's stamp to the time at which it was recorded
TWIST = "geometry_msgs/msg/TwistStamped"
PARTS = (
    "std_msgs/Header header\ngeometry_msgs/Twist twist\n",
    "MSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n",
    "MSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n",
    "MSG: geometry_msgs/Twist\ngeometry_msgs/Vector3 linear\ngeometry_msgs/Vector3 angular\n",
    "MSG: geometry_msgs/Vector3\nfloat64 x\nfloat64 y\nfloat64 z\n",
)
DEFINITION = ("=" * 80 + "\n").join(PARTS)
STATE = "bool engaged\nuint8 mode\nint16[] raw\nfloat32[3] wheels\nstring note\n"
AXES = ("linear/x", "linear/y", "linear/z", "angular/x", "angular/y", "angular/z")
NAMES = (*(f"/cmd/twist/{axis}" for axis in AXES), "/state/engaged", "/state/mode")


def mcap(path: Path, compression: str = "zstd") -> Path:
    from mcap.writer import CompressionType

    with path.open("wb") as stream:
        writer = McapWriter(stream, compression=getattr(CompressionType, compression.upper()), chunk_size=2048)
        twist, state = writer.register_msgdef(TWIST, DEFINITION), writer.register_msgdef("car/msg/State", STATE)
        for i, stamp in enumerate(STAMPS):
            when = {"sec": stamp // 10**9, "nanosec": stamp % 10**9}
            linear, angular = {"x": i / 8, "y": 0.0, "z": -1.0}, {"x": 0.0, "y": 0.0, "z": i / 16}
            message = {"header": {"stamp": when, "frame_id": "base"}, "twist": {"linear": linear, "angular": angular}}
            writer.write_message("/cmd", twist, message, log_time=stamp + LATE, publish_time=stamp)
            message = {"engaged": i % 2 == 0, "mode": i, "raw": [i, -i], "wheels": [0.0, 1.0, 2.0], "note": "x"}
            writer.write_message("/state", state, message, log_time=stamp + LATE, publish_time=stamp)
        writer.finish()
    return path


def cdr(layout: str, *values: float) -> bytes:
    """Little-endian CDR of plain numbers: each is aligned to its own size."""
    raw = b""
    for kind, value in zip(layout, values, strict=True):
        raw += bytes(-len(raw) % struct.calcsize(kind)) + struct.pack(f"<{kind}", value)
    return b"\0\1\0\0" + raw


Topics = dict[str, tuple[str, list[bytes]]]
"""Type and messages of each, a message a stamp."""


def sqlite(path: Path, topics: Topics, stamps: list[int] = STAMPS, late: int = LATE) -> Path:
    """As rosbag2 wrote until Iron: no definitions."""
    base = sqlite3.connect(path)
    base.executescript(
        "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT NOT NULL, type TEXT NOT NULL,"
        " serialization_format TEXT NOT NULL, offered_qos_profiles TEXT NOT NULL);"
        "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER NOT NULL, timestamp INTEGER NOT NULL,"
        " data BLOB NOT NULL); CREATE INDEX timestamp_idx ON messages (timestamp ASC);"
    )
    for number, (topic, (type_, messages)) in enumerate(topics.items(), 1):
        base.execute("INSERT INTO topics VALUES (?, ?, ?, 'cdr', '')", (number, topic, type_))
        rows = [(number, stamp + late, raw) for stamp, raw in zip(stamps, messages, strict=True)]
        base.executemany("INSERT INTO messages(topic_id, timestamp, data) VALUES (?, ?, ?)", rows)
    base.commit()
    base.close()
    return path


def control(i: int, newest: bool) -> bytes:
    """Autoware's command; its newest layout has a second time in each of three places."""
    when = divmod(STAMPS[i], 10**9)
    twice, times = (when * 2, "iIiI") if newest else (when, "iI")
    layout = f"{times}{times}ff?{times}fff??"
    return cdr(layout, *twice, *twice, 0.1, 0.2, 1, *twice, 10.0, i / 8, 0.5, 1, 0)


def autoware_topics(newest: bool = True) -> Topics:
    return {
        "/control/command/control_cmd": (
            "autoware_control_msgs/msg/Control",
            [control(i, newest) for i in range(COUNT)],
        ),
        "/vehicle/status/control_mode": (
            "autoware_vehicle_msgs/msg/ControlModeReport",
            [cdr("iIB", *divmod(stamp, 10**9), 1) for stamp in STAMPS],
        ),
        "/odd": ("car_msgs/msg/Odd", [b"\0\1\0\0" for _ in STAMPS]),
        "/speed": ("std_msgs/msg/Float64", [cdr("d", i / 4) for i in range(COUNT)]),
    }


def autoware(path: Path, newest: bool = True) -> Path:
    return sqlite(path, autoware_topics(newest))


def folder_of(path: Path, topics: Topics, stamps: list[int] = STAMPS, late: int = LATE) -> Path:
    """As `ros2 bag record` leaves it: a database, and what is in it."""
    path.mkdir()
    sqlite(path / "drive_0.db3", topics, stamps, late)
    listing = "".join(
        f"    - topic_metadata:\n        name: {name}\n        type: {type_}\n        serialization_format: cdr\n"
        f"        offered_qos_profiles: ''\n      message_count: {len(stamps)}\n"
        for name, (type_, _) in topics.items()
    )
    (path / "metadata.yaml").write_text(
        "rosbag2_bagfile_information:\n  version: 4\n  storage_identifier: sqlite3\n"
        "  relative_file_paths:\n    - drive_0.db3\n"
        f"  duration:\n    nanoseconds: {stamps[-1] - stamps[0]}\n"
        f"  starting_time:\n    nanoseconds_since_epoch: {stamps[0]}\n  message_count: {len(topics) * len(stamps)}\n"
        f"  topics_with_message_count:\n{listing}  compression_format: ''\n  compression_mode: ''\n"
    )
    return path


def folder(path: Path) -> Path:
    return folder_of(path, autoware_topics())


def ros1(path: Path) -> Path:
    from rosbags.rosbag1 import Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC)
    types = store.types
    vector, header = types["geometry_msgs/msg/Vector3"], types["std_msgs/msg/Header"]
    with Writer(path) as writer:
        connection = writer.add_connection("/cmd", TWIST, typestore=store)
        bare = writer.add_connection("/speed", "std_msgs/msg/Float64", typestore=store)
        for i, stamp in enumerate(STAMPS):
            when = types["builtin_interfaces/msg/Time"](sec=stamp // 10**9, nanosec=stamp % 10**9)
            twist = types["geometry_msgs/msg/Twist"](
                linear=vector(x=i / 8, y=0.0, z=-1.0), angular=vector(x=0.0, y=0.0, z=i / 16)
            )
            message = types[TWIST](header=header(seq=i, stamp=when, frame_id="base"), twist=twist)
            writer.write(connection, stamp + LATE, store.serialize_ros1(message, TWIST))
            message = types["std_msgs/msg/Float64"](data=i / 4)
            writer.write(bare, stamp + LATE, store.serialize_ros1(message, "std_msgs/msg/Float64"))
    return path


def nearest(stamps: list[int]) -> list[float]:
    """The float64 nearest to each time: division of integers rounds once."""
    return [stamp / 10**9 for stamp in stamps]


@pytest.mark.parametrize("compression", ["none", "lz4", "zstd"])
def test_mcap_of_its_own_writer(tmp_path: Path, compression: str) -> None:
    recording = open_here(mcap(tmp_path / "drive.mcap", compression))
    assert recording.form == "ROS 2 bag (MCAP)"
    assert recording.names == NAMES
    channels = recording.read(NAMES)
    assert channels["/cmd/twist/linear/x"].values.tolist() == [i / 8 for i in range(COUNT)]
    assert channels["/cmd/twist/angular/z"].values.tolist() == [i / 16 for i in range(COUNT)]
    assert channels["/cmd/twist/linear/x"].time.tolist() == nearest(STAMPS)
    assert channels["/state/mode"].values.tolist() == list(range(COUNT))
    assert channels["/state/engaged"].values.tolist() == [float(i % 2 == 0) for i in range(COUNT)]
    assert channels["/state/mode"].time.tolist() == nearest([stamp + LATE for stamp in STAMPS])


@pytest.mark.parametrize("newest", [True, False])
def test_autowares_types_are_known_where_the_bag_does_not_say(tmp_path: Path, newest: bool) -> None:
    recording = open_here(autoware(tmp_path / "drive.db3", newest))
    assert recording.form == "ROS 2 bag (SQLite)"
    assert recording.remarks == ("topics left out, their type is unknown or differs: /odd",)
    names = [
        "/control/command/control_cmd/longitudinal/acceleration",
        "/vehicle/status/control_mode/mode",
        "/speed/data",
    ]
    channels = recording.read(names)
    assert channels[names[0]].values.tolist() == [i / 8 for i in range(COUNT)]
    assert channels[names[0]].time.tolist() == nearest(STAMPS)
    assert channels[names[1]].values.tolist() == [1.0] * COUNT
    assert channels[names[2]].values.tolist() == [i / 4 for i in range(COUNT)]
    assert channels[names[2]].time.tolist() == nearest([stamp + LATE for stamp in STAMPS])


def test_a_bag_that_is_a_folder(tmp_path: Path) -> None:
    path = folder(tmp_path / "drive")
    assert is_recording(path)
    recording = open_here(path)
    assert recording.form == "ROS 2 bag (folder)"
    assert recording.read(["/speed/data"])["/speed/data"].values.tolist() == [i / 4 for i in range(COUNT)]


def test_a_bag_of_ros_1(tmp_path: Path) -> None:
    recording = open_here(ros1(tmp_path / "drive.bag"))
    assert recording.form == "ROS 1 bag"
    assert recording.names == ("/cmd/header/seq", *NAMES[:6], "/speed/data")
    channels = recording.read(["/cmd/twist/linear/x", "/speed/data"])
    assert channels["/cmd/twist/linear/x"].values.tolist() == [i / 8 for i in range(COUNT)]
    assert channels["/cmd/twist/linear/x"].time.tolist() == nearest(STAMPS)
    assert channels["/speed/data"].time.tolist() == nearest([stamp + LATE for stamp in STAMPS])


def test_a_stamp_that_is_not_set_is_no_time(tmp_path: Path) -> None:
    """A node that leaves the stamp at 0: the time of recording is taken for all of the topic."""
    messages = [cdr("iIB", *(divmod(stamp, 10**9) if i else (0, 0)), 1) for i, stamp in enumerate(STAMPS)]
    path = sqlite(tmp_path / "drive.db3", {"/mode": ("autoware_vehicle_msgs/msg/ControlModeReport", messages)})
    channel = open_here(path).read(["/mode/mode"])["/mode/mode"]
    assert channel.time.tolist() == nearest([stamp + LATE for stamp in STAMPS])


def test_only_topics_that_are_asked_for_are_decoded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from rosbags.typesys.store import Typestore

    decoded: list[str] = []
    decode = Typestore.deserialize_cdr
    monkeypatch.setattr(
        Typestore, "deserialize_cdr", lambda self, raw, name: (decoded.append(name), decode(self, raw, name))[1]
    )
    recording = open_here(mcap(tmp_path / "drive.mcap"))
    assert decoded == []
    recording.read(["/state/mode"])
    assert decoded == ["car/msg/State"] * COUNT


def test_a_message_that_is_no_message_names_topic_and_number(tmp_path: Path) -> None:
    messages = [cdr("d", i / 4) for i in range(COUNT)]
    messages[41] = b"\0\1\0\0\0"
    path = sqlite(tmp_path / "drive.db3", {"/speed": ("std_msgs/msg/Float64", messages)})
    refused(path, "topic '/speed': message 42: is damaged")


def test_a_bag_of_unknown_types(tmp_path: Path) -> None:
    path = sqlite(tmp_path / "drive.db3", {"/odd": ("car_msgs/msg/Odd", [b"\0\1\0\0" for _ in STAMPS])})
    refused(path, "no message type is known: car_msgs/msg/Odd; definitions in the bag are needed")


def test_a_type_within_itself_and_types_that_multiply(tmp_path: Path) -> None:
    """Depth and number of fields are bounded, whatever the definitions say."""
    from avtorch.io.formats.bags import numeric_fields

    loop = {"a": ((), [("x", (1, ("float64", 0))), ("a", (2, "a"))])}
    assert numeric_fields(loop, "a") == [".".join([*["a"] * depth, "x"]) for depth in range(8)]
    many = {str(n): ((), [(f"f{k}", (2, str(n + 1))) for k in range(50)]) for n in range(7)}
    many["7"] = ((), [("x", (1, ("float64", 0)))])
    assert len(numeric_fields(many, "0")) == 2000


def test_a_database_that_is_no_bag(tmp_path: Path) -> None:
    path = tmp_path / "drive.db3"
    with closing(sqlite3.connect(path)) as base:
        base.execute("CREATE TABLE songs(name TEXT)")
        base.commit()
    refused(path, "an undamaged ROS bag with its index")


@pytest.mark.slow
def test_a_view_that_computes_without_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = autoware(tmp_path / "drive.db3")
    with closing(sqlite3.connect(path)) as base:
        base.execute("DROP TABLE topics")
        base.execute(
            "CREATE VIEW topics AS WITH RECURSIVE n(id) AS (SELECT 1 UNION ALL SELECT id + 1 FROM n) "
            "SELECT id, 'x' AS name, 'std_msgs/msg/Float64' AS type, 'cdr' AS serialization_format, '' AS "
            "offered_qos_profiles, '' AS type_description_hash FROM n"
        )
        base.commit()
    monkeypatch.setattr(apart, "MOST_SECONDS", 10.0)
    with pytest.raises(InputError, match=r"drive\.db3: .* needed"):
        open_recording(path)


def test_a_path_that_would_be_read_as_an_address(tmp_path: Path) -> None:
    refused(autoware(tmp_path / "a?b.db3"), "has one of ? # % in its path")


@pytest.mark.slow
def test_a_pipe_in_a_bags_folder_is_not_waited_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = folder(tmp_path / "drive")
    (path / "drive_0.db3").unlink()
    os.mkfifo(path / "drive_0.db3")
    monkeypatch.setattr(apart, "MOST_SECONDS", 10.0)
    with pytest.raises(InputError, match=r"drive: .* is needed"):
        open_recording(path)


WRITERS: dict[str, Callable[[Path], Path]] = {"mcap": mcap, "db3": autoware, "bag": ros1}


@pytest.mark.parametrize("form", WRITERS)
def test_damage_is_read_or_refused(tmp_path: Path, form: str, fresh_seed: int) -> None:
    path = WRITERS[form](tmp_path / f"drive.{form}")
    survives(path, path.read_bytes(), fresh_seed, cuts=8, flips=20)


@pytest.mark.parametrize("form", ["mcap", "bag"])
def test_a_bag_that_was_cut_off_says_how_to_mend_it(tmp_path: Path, form: str) -> None:
    path = WRITERS[form](tmp_path / f"drive.{form}")
    raw = path.read_bytes()
    path.write_bytes(raw[: len(raw) * 4 // 5])
    refused(path, "`rosbag reindex` or `mcap recover` mends one that was cut off")


def test_damage_to_the_folders_metadata_is_read_or_refused(tmp_path: Path, fresh_seed: int) -> None:
    import random

    from tests.damage import KINDS, damaged

    from .survival import outcome

    path, rng = folder(tmp_path / "drive"), random.Random(fresh_seed)
    raw = (path / "metadata.yaml").read_bytes()
    for i in range(10):
        (path / "metadata.yaml").write_bytes(damaged(raw, i % KINDS, rng))
        said = outcome(path)
        assert not isinstance(said, str) or said.isprintable()


@pytest.mark.parametrize("count", ["", "many", "[4]"])
def test_a_folder_is_read_whatever_its_metadata_counts(tmp_path: Path, count: str) -> None:
    """A count that is no number ended in a TypeError; the messages are there all the same."""
    path = folder(tmp_path / "drive")
    metadata = path / "metadata.yaml"
    text = metadata.read_text()
    whole = open_here(path)
    damaged = re.sub(r"(?m)^(\s*(?:- )?message_count:).*$", rf"\1 {count}", text)
    assert damaged != text
    metadata.write_text(damaged)
    again = open_here(path)
    assert again.names == whole.names
    for name, channel in whole.read(whole.names).items():
        np.testing.assert_array_equal(again.read([name])[name].values, channel.values)
