"""Apollo records: by cyber-record's writer, of the messages that Apollo's own definitions make."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

import avtorch
from avtorch.errors import InputError
from avtorch.io.formats import is_recording, open_recording

from .survival import open_here, refused, survives

pytest.importorskip("cyber_record", reason="pip install 'avtorch[apollo]'")
pytest.importorskip("wheelos_msgs", reason="pip install 'avtorch[test]'")

COUNT, STEP_S, START_S, LATE_NS = 800, 0.01, 1_700_000_000.0, 3_000_000
FIELDS = {
    "accel_cmd": "/apollo/control/acceleration",
    "speed": "/apollo/canbus/chassis/speed_mps",
    "accel": "/apollo/localization/pose/pose/linear_acceleration_vrf/y",
    "engaged": "/apollo/canbus/chassis/driving_mode",
}


def record(path: Path, count: int = COUNT) -> Path:
    """A car that follows its command at once, in Apollo's frame: y is forward."""
    from cyber_record.record import Record
    from wheelos_msgs.chassis_msgs.chassis_pb2 import Chassis
    from wheelos_msgs.control_msgs.control_cmd_pb2 import ControlCommand
    from wheelos_msgs.localization_msgs.localization_pb2 import LocalizationEstimate

    with Record(str(path), mode="w") as out:
        for i in range(count):
            t = STEP_S * i
            chassis = Chassis(speed_mps=10 + math.sin(0.5 * t), driving_mode=1 if t > 1 else 0)
            control = ControlCommand(acceleration=0.5 * math.cos(0.5 * t))
            where = LocalizationEstimate()
            where.pose.linear_acceleration_vrf.y = 0.5 * math.cos(0.5 * t)
            at = round((START_S + t) * 1e9) + LATE_NS
            for topic, message in (
                ("/apollo/canbus/chassis", chassis),
                ("/apollo/control", control),
                ("/apollo/localization/pose", where),
            ):
                message.header.timestamp_sec = START_S + t
                out.write(topic, message, at)
    return path


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record(tmp_path_factory.mktemp("apollo") / "drive.record.00000")


def test_fields_are_read_at_the_stamps_of_their_headers(written: Path) -> None:
    assert is_recording(written)
    recording = open_recording(written)  # in a process of its own
    assert recording.form == "Apollo record"
    channels = recording.read(FIELDS.values())
    t = STEP_S * np.arange(COUNT)
    for channel in channels.values():
        assert channel.time == pytest.approx(START_S + t, abs=1e-6)  # not the 3 ms later at which it was recorded
    assert channels[FIELDS["accel_cmd"]].values == pytest.approx(0.5 * np.cos(0.5 * t), abs=1e-12)
    # speed is a float of 32 bits
    assert channels[FIELDS["speed"]].values == pytest.approx(10 + np.sin(0.5 * t), abs=1e-6)
    assert np.array_equal(channels[FIELDS["engaged"]].values, np.where(t > 1, 1.0, 0.0))


def test_what_a_message_has_not_set_is_not_zero(written: Path) -> None:
    throttle = open_here(written).read(["/apollo/canbus/chassis/throttle_percentage"])
    assert np.isnan(throttle["/apollo/canbus/chassis/throttle_percentage"].values).all()


def test_repeated_fields_and_texts_are_no_channels(written: Path) -> None:
    names = open_here(written).names
    assert "/apollo/localization/pose/pose/position/x" in names
    assert not any(name.endswith(("frame_id", "module_name")) or "trajectory_point" in name for name in names)


@pytest.mark.usefixtures("in_this_process")
def test_the_layout_is_known_and_read(written: Path) -> None:
    found = avtorch.check(written)
    assert found.fault is None
    assert found.proposal is not None
    assert {signal: found.proposal.signals[signal].column for signal in FIELDS} == FIELDS
    assert found.log is not None
    assert found.log.rows == COUNT
    assert found.log.engaged.mean() == pytest.approx(1 - 1 / 8, abs=0.01)


def test_time_is_not_to_be_mapped(written: Path) -> None:
    with pytest.raises(InputError, match="channels of a recording have clocks of their own"):
        avtorch.Log.read(written, map=["time=/apollo/canbus/chassis/header/timestamp_sec"])


def test_a_topic_without_a_definition_is_told(tmp_path: Path) -> None:
    from cyber_record.cyber.proto.proto_desc_pb2 import ProtoDesc
    from cyber_record.record import Record
    from wheelos_msgs.chassis_msgs.chassis_pb2 import Chassis

    path = tmp_path / "drive.record"
    with Record(str(path), mode="w") as out:
        for i in range(5):
            out.write("/apollo/canbus/chassis", Chassis(speed_mps=float(i)), round(START_S * 1e9) + i)
            out.write_raw("/camera", b"\x08\x01", "apollo.drivers.Image", ProtoDesc(), round(START_S * 1e9) + i)
    recording = open_here(path)
    assert recording.remarks == ("topics left out, the record does not define their type: /camera",)
    # without a stamp in the header, the time of recording
    chassis = recording.read(["/apollo/canbus/chassis/speed_mps"])["/apollo/canbus/chassis/speed_mps"]
    assert chassis.values.tolist() == [0.0, 1.0, 2.0, 3.0, 4.0]
    assert chassis.time[0] == START_S


def test_a_record_that_was_not_closed_says_how_to_mend_it(written: Path, tmp_path: Path) -> None:
    raw = written.read_bytes()
    path = tmp_path / "cut.record"
    path.write_bytes(raw[: len(raw) // 2])
    refused(path, "cyber_recorder recover")


def test_damage_is_read_or_refused(tmp_path: Path, fresh_seed: int) -> None:
    path = record(tmp_path / "drive.record", 60)
    survives(path, path.read_bytes(), fresh_seed, cuts=8, flips=20)
