"""A newcomer with a log of his own, in the form it has: two commands to a right answer."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable
from pathlib import Path

import can
import numpy as np
import pytest
from mcap_ros2.writer import Writer as McapWriter
from mf4_rs import MdfWriter, create_float_value
from scipy.io import savemat

from avtorch.cli import main
from avtorch.io import Log
from avtorch.io.units import GRAVITY

from .drives import GAIN, LAG_S, Columns, drive

START = 1_700_000_000


def semicolons(folder: Path, d: Columns) -> Path:
    """km/h with g, decimal commas, a row of units, and a driver who takes over and acts against the command."""
    engaged = (d["time"] < 20) | (d["time"] > 26)
    command = np.where(engaged, d["accel_cmd"], -d["accel_cmd"])
    columns = [d["time"], command / GRAVITY, d["accel"] / GRAVITY, 3.6 * d["speed"]]
    rows = [
        ";".join([*(f"{x:.6f}".replace(".", ",") for x in row), str(bool(on))])
        for *row, on in zip(*columns, engaged, strict=True)
    ]
    head = ["Zeit;Sollbeschleunigung;Beschleunigung;Geschwindigkeit;ACC aktiv engaged", "s;g;g;km/h;-"]
    path = folder / "drive.csv"
    path.write_bytes("\r\n".join([*head, *rows]).encode("cp1252"))
    return path


def mdf(folder: Path, d: Columns) -> Path:
    """Two groups with clocks of their own: the command at 25 Hz."""
    path = folder / "drive.mf4"
    writer = MdfWriter(str(path))
    writer.init_mdf_file()
    for group, names, every in (("ADAS", ["AccelRequest"], 2), ("ESP", ["LongAcc", "VehicleSpeed"], 1)):
        made = writer.add_channel_group(group)
        writer.add_time_channel(made, "t")
        for name in names:
            writer.add_float_channel(made, name)
        writer.start_data_block(made)
        of = {"AccelRequest": d["accel_cmd"], "LongAcc": d["accel"], "VehicleSpeed": 3.6 * d["speed"]}
        for i in range(0, len(d["time"]), every):
            record = [d["time"][i], *(of[name][i] for name in names)]
            writer.write_record(made, [create_float_value(float(x)) for x in record])
        writer.finish_data_block(made)
    writer.finalize()
    return path


TIME = "builtin_interfaces/Time"
CONTROL = ("=" * 80 + "\n").join(
    [
        "builtin_interfaces/Time stamp\ncar/Longitudinal longitudinal\n",
        "MSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n",
        "MSG: car/Longitudinal\nfloat64 velocity\nfloat64 acceleration\n",
    ]
)
VELOCITY = ("=" * 80 + "\n").join(
    [
        "std_msgs/Header header\nfloat32 longitudinal_velocity\nfloat32 lateral_velocity\n",
        "MSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n",
        "MSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n",
    ]
)
MODE = ("=" * 80 + "\n").join(
    ["builtin_interfaces/Time stamp\nuint8 mode\n", "MSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"]
)


def mcap(folder: Path, d: Columns) -> Path:
    """Autoware's topics; the control mode is 1 where the car drives itself."""
    path = folder / "drive.mcap"
    with path.open("wb") as stream:
        writer = McapWriter(stream)
        control = writer.register_msgdef("car/msg/Control", CONTROL)
        velocity = writer.register_msgdef("car/msg/VelocityReport", VELOCITY)
        mode = writer.register_msgdef("car/msg/ControlModeReport", MODE)
        for t, u, v in zip(d["time"], d["accel_cmd"], d["speed"], strict=True):
            stamp = START * 10**9 + round(t * 1e9)
            when = {"sec": stamp // 10**9, "nanosec": stamp % 10**9}
            writer.write_message(
                "/control/command/control_cmd",
                control,
                {"stamp": when, "longitudinal": {"velocity": 0.0, "acceleration": u}},
                log_time=stamp,
            )
            message = {"longitudinal_velocity": v, "lateral_velocity": 0.0}
            message["header"] = {"stamp": when, "frame_id": "base_link"}
            writer.write_message("/vehicle/status/velocity_status", velocity, message, log_time=stamp)
            writer.write_message(
                "/vehicle/status/control_mode", mode, {"stamp": when, "mode": 1 if t < 50 else 4}, log_time=stamp
            )
        writer.finish()
    return path


DBC = """VERSION ""

NS_ :

BS_:

BU_: ECU

BO_ 256 Chassis: 8 ECU
 SG_ VehSpd : 0|16@1+ (0.01,0) [0|655.35] "km/h" ECU
 SG_ LongAccel : 16|16@1- (0.0001,0) [-3|3] "g" ECU

BO_ 512 Adas: 8 ECU
 SG_ AccelRequest : 0|16@1- (0.0005,0) [-16|16] "m/s2" ECU
"""


def blf(folder: Path, d: Columns) -> Path:
    path = folder / "drive.blf"
    (folder / "car.dbc").write_text(DBC)
    with can.BLFWriter(path) as writer:
        for t, u, a, v in zip(*(d[name] for name in ("time", "accel_cmd", "accel", "speed")), strict=True):
            raw = struct.pack("<h", round(u / 0.0005)) + bytes(6)
            writer.on_message_received(
                can.Message(timestamp=START + t, arbitration_id=0x200, is_extended_id=False, data=raw)
            )
            raw = struct.pack("<Hh", round(360 * v), round(a / GRAVITY / 0.0001)) + bytes(4)
            writer.on_message_received(
                can.Message(timestamp=START + t, arbitration_id=0x100, is_extended_id=False, data=raw)
            )
    return path


def mat(folder: Path, d: Columns) -> Path:
    path = folder / "drive.mat"
    names = {"t": "time", "a_des": "accel_cmd", "ax": "accel", "vx": "speed"}
    savemat(path, {"log": {name: d[column] for name, column in names.items()}})
    return path


@pytest.mark.parametrize(
    "write",
    [semicolons, *(pytest.param(w, marks=pytest.mark.slow) for w in (mdf, mcap, blf, mat))],
    ids=lambda write: write.__name__,
)
def test_check_and_estimate_lead_to_the_cars_lag_and_gain(
    write: Callable[[Path, Columns], Path],
    tmp_path: Path,
    fresh_seed: int,
    capsys: pytest.CaptureFixture[str],
) -> None:
    d = drive(fresh_seed)
    path = write(tmp_path, d)
    assert main(["check", str(path), "--yes"]) == 0
    assert f"Written to {tmp_path / 'drive.toml'}" in capsys.readouterr().out
    log = Log.read(path)
    assert abs(log.rate_hz - 50.0) < 1e-3
    assert log.engaged.all() != (write in (semicolons, mcap))
    out = tmp_path / "out"
    assert main(["estimate", str(path), "--out", str(out), "--window", "5", "--quiet"]) == 0
    windows = [w for w in json.loads((out / "estimates.json").read_text())["windows"] if w["used"]]
    last = windows[-1]
    for name, truth in (("T_L", LAG_S), ("K_L", GAIN)):
        assert abs(last[name]["mean"] - truth) < 5 * last[name]["sd"] + 0.02, name
