"""`avtorch estimate` on a log of pedals: it makes a command of them first, and says what that cannot tell."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest

from avtorch import Leader, simulate
from avtorch.cli import main
from tests.pedals import speed_cars
from tests.pedals.cars import drive, plain


@pytest.mark.slow
def test_estimate_makes_a_map_first(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    drive(plain, 41, seconds=60.0).write(tmp_path / "lap.csv")
    out = tmp_path / "out"
    arguments = ["--window", "20", "--estimator", "ekf", "--out", str(out)]
    assert main(["estimate", str(tmp_path / "lap.csv"), *arguments]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "a map of throttle and brake and speed stands for it" in said
    assert "K_L is 1 by the map's scale" in said
    for name in ("pedal_map.csv", "accel_map.csv", "brake_map.csv", "pedal_map.png"):
        assert (out / name).stat().st_size > 0
    assert "cannot be told apart" in json.loads((out / "estimates.json").read_text())["command"]


@pytest.mark.slow
def test_estimate_makes_a_map_of_a_commanded_speed_first(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    speed_cars.drive(42, seconds=60.0, steps=True).write(tmp_path / "lap.csv")
    out = tmp_path / "out"
    arguments = ["--window", "20", "--estimator", "ekf", "--out", str(out)]
    assert main(["estimate", str(tmp_path / "lap.csv"), *arguments]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "a map of speed_error and speed stands for it (speed_error -" in said
    assert "The command answers to the measured speed, and so to its noise" in said
    for name in ("pedal_map.csv", "pedal_map.png"):
        assert (out / name).stat().st_size > 0
    assert not (out / "accel_map.csv").exists()


def test_a_commanded_speed_that_never_moves_is_refused_in_one_line(
    tmp_path: Path, refused: Callable[[list[str]], str]
) -> None:
    log = tmp_path / "lap.csv"
    log.write_text("time,speed,speed_cmd\n" + "".join(f"{0.05 * i:.2f},{10 + i % 7},12\n" for i in range(400)))
    assert "found no speed_cmd that moves" in refused(["estimate", str(log), "--out", str(tmp_path / "out")])


@pytest.mark.slow
def test_a_map_of_an_earlier_log_does_not_stay_beside_an_answer_without_one(tmp_path: Path) -> None:
    out = tmp_path / "out"
    out.mkdir()
    kept = out / "notes.csv"
    left = [out / name for name in ("pedal_map.csv", "accel_map.csv", "brake_map.csv", "pedal_map.png")]
    for path in (*left, kept):
        path.write_text("of the earlier log\n")
    (out / "estimates.json").write_text(json.dumps({"files": {path.name: "" for path in left}}))
    run = simulate(Leader.default(start=50.0, duration=4.0, dt=0.02))
    run.log().write(tmp_path / "lap.csv")
    assert main(["estimate", str(tmp_path / "lap.csv"), "--estimator", "map", "--quiet", "--out", str(out)]) == 0
    assert not any(path.exists() for path in left)
    assert kept.exists()
