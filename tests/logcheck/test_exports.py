"""Exports of many shapes: every signal is assigned rightly or asked about, none wrongly."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

import avtorch
from avtorch.cli import main
from avtorch.io import Log
from avtorch.io.units import GRAVITY

from .drives import Columns, drive

MPH = 3600 / 1609.344


class Export(NamedTuple):
    """Columns of a file under names that may repeat; `means`: signals by the columns that may stand for each of them;
    `asked`: signals about which a question is the right answer; `units`: a second row of the file."""

    columns: list[tuple[str, np.ndarray]]
    means: dict[str, tuple[str, ...]]
    asked: tuple[str, ...] = ()
    units: str = ""


class Car(NamedTuple):
    """A drive and what else its bus carries (row,)."""

    time: np.ndarray
    command: np.ndarray
    accel: np.ndarray
    speed: np.ndarray
    lateral: np.ndarray
    yaw: np.ndarray
    on: np.ndarray
    throttle: np.ndarray
    brake: np.ndarray

    @classmethod
    def of(cls, seed: int) -> Car:
        d: Columns = drive(seed, seconds=90.0)
        rng = np.random.default_rng(seed + 1)
        bends = np.convolve(rng.standard_normal(len(d["time"])), np.hanning(301) / 12, mode="same")
        on = (np.arange(len(bends)) % 1500 > 40).astype(float)
        u = d["accel_cmd"]
        noise = 0.05 * rng.standard_normal(len(bends))
        return cls(
            d["time"], u, d["accel"], d["speed"], 1.5 * bends + noise, 1.5 * bends / d["speed"], on,
            np.clip(u / 4 + 0.05, 0.0, 1.0), np.clip(-u / 6 - 0.01, 0.0, 1.0),
        )  # fmt: skip


def whole(values: np.ndarray) -> np.ndarray:
    return np.floor(values)


EXPORTS: dict[str, Callable[[Car], Export]] = {
    "a flag named as an acceleration": lambda c: Export(
        [("Timestamp", c.time), ("ACC_accel_req", c.command), ("ACC_Active", c.on), ("VehSpd_kph", 3.6 * c.speed),
         ("LongAcc_g", c.accel / GRAVITY), ("LatAcc_g", c.lateral / GRAVITY), ("YawRate", c.yaw)],
        {"accel_cmd": ("ACC_accel_req",), "accel": ("LongAcc_g",), "speed": ("VehSpd_kph",)},
    ),
    "a brake by its torque": lambda c: Export(
        [("t", c.time), ("throttle", c.throttle), ("brake_torque_request", 3200 * c.brake), ("vehicle_speed", c.speed),
         ("accel_x", c.accel)],
        {"throttle": ("throttle",), "brake": ("brake_torque_request",), "speed": ("vehicle_speed",),
         "accel": ("accel_x",)},
    ),
    "German": lambda c: Export(
        [("Zeit [s]", c.time), ("Soll_Beschleunigung", c.command), ("Laengsbeschleunigung", c.accel),
         ("Querbeschleunigung", c.lateral), ("Geschwindigkeit [km/h]", 3.6 * c.speed),
         ("Fahrpedal [%]", 100 * c.throttle)],
        {"accel_cmd": ("Soll_Beschleunigung",), "accel": ("Laengsbeschleunigung",),
         "speed": ("Geschwindigkeit [km/h]",)},
    ),
    "German pedals": lambda c: Export(
        [("Zeit", c.time), ("Fahrpedal [%]", 100 * c.throttle), ("Bremsdruck [bar]", 80 * c.brake),
         ("v_Fzg [km/h]", 3.6 * c.speed), ("Bremslicht", (c.brake > 0).astype(float))],
        {"throttle": ("Fahrpedal [%]",), "brake": ("Bremsdruck [bar]",), "speed": ("v_Fzg [km/h]",)},
    ),
    "French": lambda c: Export(
        [("Temps (s)", c.time), ("Acceleration demandee", c.command), ("Acceleration mesuree", c.accel),
         ("Vitesse (km/h)", 3.6 * c.speed), ("Angle volant", c.yaw)],
        {"accel_cmd": ("Acceleration demandee",), "accel": ("Acceleration mesuree",), "speed": ("Vitesse (km/h)",)},
    ),
    "Spanish, whose words are not known": lambda c: Export(
        [("Tiempo", c.time), ("Aceleracion pedida [m/s2]", c.command), ("Aceleracion [m/s2]", c.accel),
         ("Velocidad [km/h]", 3.6 * c.speed)],
        {"accel_cmd": ("Aceleracion pedida [m/s2]",), "accel": ("Aceleracion [m/s2]",), "speed": ("Velocidad [km/h]",)},
        asked=("accel_cmd", "accel"),
    ),
    "abbreviations": lambda c: Export(
        [("t", c.time), ("a_req", c.command), ("a_act", c.accel), ("v_act", c.speed), ("psi_p", c.yaw)],
        {"accel_cmd": ("a_req",), "accel": ("a_act",), "speed": ("v_act",)},
    ),
    "a name twice": lambda c: Export(
        [("time", c.time), ("accel_cmd", c.command), ("accel", c.accel), ("Speed", c.speed), ("Speed", 3.6 * c.speed)],
        {"accel_cmd": ("accel_cmd",), "accel": ("accel",), "speed": ("Speed",)},
        asked=("speed",),
    ),
    "units in a second row": lambda c: Export(
        [("Time", c.time), ("AccDem", c.command / GRAVITY), ("AccX", c.accel / GRAVITY), ("Speed", MPH * c.speed)],
        {"accel_cmd": ("AccDem",), "accel": ("AccX",), "speed": ("Speed",)},
        units="s,g,g,mph",
    ),
    "prefixes of a bus": lambda c: Export(
        [("timestamps", c.time), ("ESP_21::ESP_v_Signal [km/h]", 3.6 * c.speed),
         ("ACC_06::ACC_Sollbeschleunigung_02", c.command), ("ESP_02::ESP_Laengsbeschl [g]", c.accel / GRAVITY),
         ("ESP_02::ESP_Querbeschl [g]", c.lateral / GRAVITY), ("ACC_06::ACC_Status_ACC", 3 * c.on),
         ("ESP_21::COUNTER", whole(c.time * 50) % 16)],
        {"accel_cmd": ("ACC_06::ACC_Sollbeschleunigung_02",), "accel": ("ESP_02::ESP_Laengsbeschl [g]",),
         "speed": ("ESP_21::ESP_v_Signal [km/h]",)},
    ),
    "flags of everything": lambda c: Export(
        [("time", c.time), ("accel_cmd_valid", c.on), ("LKA_active", 1 - c.on), ("AEB_accel_req", np.zeros_like(c.on)),
         ("des_accel", c.command), ("accel_meas", c.accel), ("speed_meas", c.speed), ("Acc", c.on)],
        {"accel_cmd": ("des_accel",), "accel": ("accel_meas",), "speed": ("speed_meas",)},
    ),
    "the axis of another README": lambda c: Export(
        [("time", c.time), ("speed_cmd", c.speed + 0.8 * c.command), ("speed", c.speed),
         ("imu_ax_g", c.lateral / GRAVITY),
         ("imu_ay_g", -c.accel / GRAVITY), ("imu_az_g", 1 + 0.0 * c.accel + 0.01 * c.yaw)],
        {"speed_cmd": ("speed_cmd",), "speed": ("speed",), "accel": ("imu_ay_g",)},
        asked=("accel",),
    ),
    "wheels and satellites": lambda c: Export(
        [("time", c.time),
         *((f"WheelSpd_{w}_kph", 3.6 * c.speed * (1 + 0.002 * i)) for i, w in enumerate(("FL", "FR", "RL", "RR"))),
         ("VehSpd_kph", 3.6 * c.speed), ("GPS_speed", c.speed), ("AccelCmd", c.command), ("LongAccel", c.accel)],
        {"accel_cmd": ("AccelCmd",), "accel": ("LongAccel",), "speed": ("VehSpd_kph", "GPS_speed")},
    ),
    "an engine's answer beside the throttle": lambda c: Export(
        [("time", c.time), ("throttle", c.throttle),
         ("engine_torque", 250 * np.convolve(c.throttle, np.full(10, 0.1), mode="same")),
         ("engine_rpm", 90 * c.speed), ("speed", c.speed)],
        {"throttle": ("throttle",), "speed": ("speed",)},
    ),
    "two torques": lambda c: Export(
        [("time", c.time), ("motor_torque_cmd_Nm", 220 * c.command), ("motor_torque_actual_Nm", 225 * c.accel),
         ("v_mps", c.speed), ("a_long", c.accel)],
        {"torque": ("motor_torque_cmd_Nm",), "speed": ("v_mps",), "accel": ("a_long",)},
    ),
    "topics and stamps of ROS": lambda c: Export(
        [("/odom/header/stamp/sec", 1.7e9 + whole(c.time)),
         ("/odom/header/stamp/nanosec", np.round((c.time % 1) * 1e9)),
         ("/status/cmd_vel/linear/x", c.speed + 0.8 * c.command), ("/imu/linear_acceleration/x", c.accel),
         ("/imu/linear_acceleration/y", c.lateral), ("/imu/angular_velocity/z", c.yaw),
         ("/odom/velocity/linear/x", c.speed)],
        {"time": ("/odom/header/stamp/sec + /odom/header/stamp/nanosec",), "speed_cmd": ("/status/cmd_vel/linear/x",),
         "accel": ("/imu/linear_acceleration/x",), "speed": ("/odom/velocity/linear/x",)},
    ),
    "a leader": lambda c: Export(
        [("time", c.time), ("lead_speed", c.speed + 0.5 * np.sin(c.time / 9)), ("gap_m", 30 + np.sin(c.time / 7)),
         ("ego_v", c.speed), ("ego_accel", c.accel), ("target_accel", c.command)],
        {"accel_cmd": ("target_accel",), "accel": ("ego_accel",), "speed": ("ego_v",)},
    ),
    "a command without a name": lambda c: Export(
        [("time", c.time), ("signal 17", c.command), ("speed", c.speed), ("accel", c.accel), ("signal 18", c.lateral)],
        {"accel_cmd": ("signal 17",), "accel": ("accel",), "speed": ("speed",)},
        asked=("accel_cmd",),  # where the other one happens to go with the speed, too
    ),
    "pedals in per cent": lambda c: Export(
        [("Time", c.time), ("AccelPedalPos [%]", 100 * c.throttle), ("BrakePedalPos [%]", 100 * c.brake),
         ("VehSpd [mph]", MPH * c.speed), ("LongAccel [g]", c.accel / GRAVITY)],
        {"throttle": ("AccelPedalPos [%]",), "brake": ("BrakePedalPos [%]",), "speed": ("VehSpd [mph]",),
         "accel": ("LongAccel [g]",)},
    ),
    "a dead accelerometer beside a live one": lambda c: Export(
        [("time", c.time), ("accel_request", c.command),
         ("accel_1", 0.02 * np.random.default_rng(0).standard_normal(len(c.time))),
         ("accel_2", c.accel), ("speed", c.speed)],
        {"accel_cmd": ("accel_request",), "accel": ("accel_2",), "speed": ("speed",)},
    ),
    "a brake in kPa that only its size tells": lambda c: Export(
        [("time", c.time), ("throttle_pos", 100 * c.throttle), ("brake_press", 9000 * c.brake), ("speed", c.speed)],
        {"throttle": ("throttle_pos",), "brake": ("brake_press",), "speed": ("speed",)},
    ),
}  # fmt: skip


def written(folder: Path, export: Export) -> Path:
    path = folder / "drive.csv"
    rows = zip(*(map("{:.10g}".format, values.tolist()) for _, values in export.columns), strict=True)
    head = [",".join(name for name, _ in export.columns), *([export.units] if export.units else [])]
    path.write_text("\n".join([*head, *map(",".join, rows)]), encoding="utf-8")
    return path


@pytest.mark.parametrize("shape", EXPORTS)
def test_every_signal_is_assigned_rightly_or_asked_about(shape: str, tmp_path: Path, fresh_seed: int) -> None:
    car = Car.of(fresh_seed)
    export = EXPORTS[shape](car)
    found = avtorch.check(written(tmp_path, export))
    assert found.proposal is not None
    signals, doubts = found.proposal.signals, " ".join(found.proposal.doubts)
    for signal, columns in export.means.items():
        if signal in signals:
            assert signals[signal].column in columns
        else:
            assert signal in export.asked
            assert f"--map {signal}=" in doubts or "rename" in doubts
            assert any(column in doubts for column in columns)
    for signal in ("accel_cmd", "accel", "speed", "throttle", "brake", "torque", "current", "speed_cmd"):
        if signal not in export.means and signal in signals:
            assert signals[signal].column == signal, f"{signal} is no part of this log"
    if found.log is not None:
        for signal, values in (("accel_cmd", car.command), ("accel", car.accel), ("speed", car.speed)):
            read = getattr(found.log, signal)
            if signal in signals and signal in export.means:
                assert read is not None
                assert np.allclose(read, values, rtol=1e-6, atol=1e-6), signal


def test_units_of_brakes_are_told_by_size_and_name(tmp_path: Path) -> None:
    for shape, unit in (("a brake by its torque", "Nm"), ("German pedals", "bar")):
        found = avtorch.check(written(tmp_path, EXPORTS[shape](Car.of(3))))
        assert found.proposal is not None
        assert found.proposal.unit["brake"] == unit
        (tmp_path / "drive.csv").unlink()
    found = avtorch.check(written(tmp_path, EXPORTS["a brake in kPa that only its size tells"](Car.of(3))))
    assert found.proposal is not None
    assert any("--unit brake=kPa" in doubt and "--unit brake=Nm" in doubt for doubt in found.proposal.doubts)


def test_a_pedal_left_over_is_asked_about(tmp_path: Path) -> None:
    found = avtorch.check(written(tmp_path, EXPORTS["an engine's answer beside the throttle"](Car.of(3))))
    assert found.proposal is not None
    assert "torque" not in found.proposal.signals
    assert any("engine_torque" in doubt for doubt in found.proposal.doubts)


def test_what_is_asked_can_be_answered_on_the_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    car = Car.of(3)
    path = written(tmp_path, EXPORTS["the axis of another README"](car))
    found = avtorch.check(path)
    assert found.proposal is not None
    (asked,) = (doubt for doubt in found.proposal.doubts if "imu_ay_g" in doubt)
    assert "imu_ax_g" in asked
    assert main(["check", str(path), "--map", "accel=imu_ay_g", "--yes"]) == 0
    log = Log.read(path)
    assert log.accel is not None
    assert np.allclose(log.accel, car.accel, rtol=1e-6, atol=1e-6)
    capsys.readouterr()
