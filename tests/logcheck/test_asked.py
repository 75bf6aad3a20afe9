"""Logs that were read without a word and answered wrongly: now `check` says what is odd, in one line, and asks."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

import avtorch
from avtorch import InputError
from avtorch.cli import main
from avtorch.io import Log
from avtorch.io import check as quality

from .drives import GAIN, drive, written


def notes(log: Log) -> str:
    return "\n".join(quality(log).notes)


@pytest.mark.parametrize("factor", [0.85, 1.2])
def test_a_wheel_of_another_radius_is_told_and_both_readings_named(factor: float, fresh_seed: int) -> None:
    d = drive(fresh_seed, seconds=120.0)
    d["speed"] = factor * d["speed"]
    said = notes(Log.from_arrays(**d))
    assert f"speed changes {factor:.1g}" in said or f"speed changes {factor:.2g}" in said
    assert "a wheel's radius" in said
    assert "the accelerometer's scale" in said


@pytest.mark.parametrize("noise", [0.0, 0.3, 1.0])
def test_noise_and_a_filter_are_no_factor(noise: float, fresh_seed: int) -> None:
    """Noise lowers the slope of one channel over the other, and so does what makes one of them late."""
    d = drive(fresh_seed)
    rng = np.random.default_rng(fresh_seed)
    d["accel"] = d["accel"] + noise * np.convolve(rng.standard_normal(len(d["time"])), np.full(50, 0.1), mode="same")
    speed = d["speed"].copy()
    for i in range(1, len(speed)):
        speed[i] = speed[i - 1] + (d["speed"][i] - speed[i - 1]) / 20  # 0.4 s
    for one in (d, d | {"speed": speed}):
        assert "times as much as accel" not in notes(Log.from_arrays(**one))


@pytest.mark.parametrize("channels", [("accel",), ("accel", "speed"), ("speed",)])
def test_a_constant_that_is_no_offset_is_asked_about(channels: tuple[str, ...], fresh_seed: int) -> None:
    """A feed-forward of 3.3 m/s² that is not in the command, as seen by whatever is there."""
    d = drive(fresh_seed)
    columns = {"time": d["time"], "accel_cmd": d["accel_cmd"] - 3.3, **{name: d[name] for name in channels}}
    said = notes(Log.from_arrays(**columns))
    constant = re.search(r"the command plus ([0-9.]+) m/s²", said)
    assert constant is not None
    assert abs(float(constant[1]) - 3.3 * GAIN) < 0.5
    assert "gravity or a feed-forward" in said
    assert "feed-forward" not in notes(Log.from_arrays(**{name: d[name] for name in columns}))


def test_an_accelerometer_is_read_at_rest() -> None:
    time = np.arange(0.0, 60.0, 0.05)
    speed = np.maximum(0.0, 3.0 * np.sin(0.3 * time))
    accel = np.gradient(speed, time) + 0.28 + 0.02 * np.random.default_rng(0).standard_normal(len(time))
    log = Log.from_arrays(time=time, accel_cmd=np.gradient(speed, time), accel=accel, speed=speed)
    assert any("accel reads 0.28 m/s² while the car stands" in note for note in avtorch.check(log).recorder)


@pytest.mark.parametrize(("top", "stands"), [(0.22, 0.022), (2.0, 0.2), (25.0, 0.3), (80.0, 0.3)])
def test_standstill_goes_with_what_was_driven(top: float, stands: float) -> None:
    """A robot, a 1:10 car, a truck and a train."""
    time = np.arange(0.0, 60.0, 0.05)
    speed = np.maximum(0.0, top * np.sin(0.1 * time))
    log = Log.from_arrays(time=time, accel_cmd=np.gradient(speed, time), speed=speed)
    assert log.standstill_mps == pytest.approx(stands, rel=0.01)
    assert 0.4 < log.moving.mean() < 0.55
    assert avtorch.check(log).fault is None
    assert f"below {stands:.2g} m/s" in notes(log)


def test_a_log_of_which_too_little_is_left_says_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    time = np.arange(0.0, 60.0, 0.05)
    speed = np.where(time % 10 < 1.5, 1.0, 0.0)
    path = written(tmp_path / "stop.csv", {"time": time, "accel_cmd": np.sin(time), "speed": speed})
    for command in (["check"], ["estimate", "--out", str(tmp_path / "e")], ["diagnose", "--out", str(tmp_path / "d")]):
        assert main([*command[:1], str(path), *command[1:]]) == 2
        seen = capsys.readouterr()
        assert "too little is left to use: the longest stretch lasts 1." in seen.err
        assert "85% of the rows are below 0.1 m/s" in seen.err
        assert len(seen.err.splitlines()) == 1
        assert "Next:" not in seen.out


def test_stamps_of_no_known_form_are_said_to_be_that(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    d = drive(1, seconds=20.0, rate=20.0)
    stamps = [f"2024_04_23_12_31_{int(t):02d}_{round(1000 * (t % 1))}" for t in d["time"].tolist()]
    columns = {"stamp": stamps, "accel_cmd": d["accel_cmd"], "speed": d["speed"]}
    path = written(tmp_path / "headed.csv", columns)
    for command in (["check"], ["estimate", "--map", "time=stamp", "--out", str(tmp_path / "e")]):
        assert main([*command[:1], str(path), *command[1:]]) == 2
        said = capsys.readouterr().err
        assert "row 1 (line 2), column 'stamp'" in said
        assert "'2024_04_23_12_31_00_0' is no number, and no time of a known form" in said


@pytest.mark.parametrize(("seconds", "nanoseconds"), [("sec", "nanosec"), ("secs", "nsecs"), ("s", "ns")])
def test_a_stamp_in_two_columns_is_one(seconds: str, nanoseconds: str, tmp_path: Path) -> None:
    d = drive(1)
    whole = np.floor(d["time"])
    columns = {
        f"header.stamp.{seconds}": 1_700_000_000 + whole.astype(int),
        f"header.stamp.{nanoseconds}": np.round((d["time"] - whole) * 1e9).astype(int),
        **{name: d[name] for name in ("accel_cmd", "accel", "speed")},
    }
    path = written(tmp_path / "bag.csv", columns)
    found = avtorch.check(path)
    assert found.fault is None
    assert found.proposal is not None
    assert found.proposal.map == {"time": f"header.stamp.{seconds} + header.stamp.{nanoseconds}"}
    path.with_suffix(".toml").write_text(found.proposal.toml(path.name))
    assert np.allclose(Log.read(path).elapsed, d["time"], rtol=0, atol=1e-9)


def test_names_in_errors_are_whole(tmp_path: Path) -> None:
    d = drive(1)
    name = "/vehicle/status/velocity_status/longitudinal_velocity_filtered"
    path = written(tmp_path / "bag.csv", {"time": d["time"], name: d["speed"], "accel_cmd": d["accel_cmd"]})
    with pytest.raises(InputError, match=name):
        Log.read(path)


def robot(folder: Path, *, columns: bool) -> list[str]:
    """A robot that follows a commanded speed, and its simulator's output in a file or in columns: arguments."""
    time = np.arange(0.0, 60.0, 0.05)
    asked = 0.25 * (1 + np.sign(np.sin(0.5 * time))) / 2
    speed = np.convolve(asked, np.full(10, 0.1), mode="full")[: len(time)]
    car = {"time": time, "speed_cmd": asked, "speed": speed}
    if columns:
        return [str(written(folder / "both.csv", car | {"sim.speed": asked})), "--simulated", "sim."]
    simulated = written(folder / "sim.csv", {"time": time, "speed_cmd": asked, "speed": asked})
    return [str(written(folder / "car.csv", car)), "--simulated", str(simulated)]


@pytest.mark.parametrize("columns", [False, True])
def test_a_simulator_with_a_loop_of_its_own_is_refused_in_one_line(
    columns: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Before: "column 'spacing' is missing", or "lacks nothing" beside errors of 0.9 m/s."""
    assert main(["diagnose", *robot(tmp_path, columns=columns), "--out", str(tmp_path / "out")]) == 2
    said = capsys.readouterr().err
    assert "--simulated" in said
    assert "commands a speed, which car and simulator follow by loops of their own" in said
    assert len(said.splitlines()) == 1
