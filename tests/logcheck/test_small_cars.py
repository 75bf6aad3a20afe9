"""Recordings of small cars: a motor whose throttle commands a speed, and a car whose accelerometer is told wrongly."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import avtorch
from avtorch.cli import main
from avtorch.io import Log
from avtorch.pedals import fit_pedals

UCAR, FRICTION = "cpm_lab_ucar/run.csv", "f110_frictionmaps/ds5.csv"


def test_the_ucar_is_read_by_its_throttle(data_dir: Path) -> None:
    """Its measured current is no second pedal; its accelerometer reads 0.28 m/s² at rest."""
    found = avtorch.check(data_dir / UCAR)
    assert found.fault is None
    assert found.proposal is not None
    assert set(found.proposal.signals) == {"time", "accel", "speed", "throttle"}
    assert found.log is not None
    assert found.log.standstill_mps == pytest.approx(0.16, abs=0.01)
    assert any("accel reads 0.28 m/s² while the car stands" in note for note in found.recorder)


def test_the_map_of_the_ucar_is_its_published_model(data_dir: Path) -> None:
    """dv/dt = (6.54 throttle^1.5926 - v) / 0.70 s after 0.031 s."""
    made = fit_pedals(Log.read(data_dir / UCAR)).map
    assert made.driven is not None
    speed = np.linspace(*made.driven, 400)
    for throttle in (0.25, 0.3, 0.4):  # at 0.5 it would go 2.2 m/s, where the log hardly is
        accel = made.accel(speed, throttle=np.full(400, throttle))
        assert np.interp(0.0, -accel, speed) == pytest.approx(6.54 * throttle**1.5926, rel=0.1)
        assert -1 / np.polyfit(speed, accel, 1)[0] == pytest.approx(0.70, rel=0.25)
    assert made.T_L + made.dead_time == pytest.approx(0.031, abs=0.06)


def test_the_axis_of_the_frictionmaps_is_asked_about(data_dir: Path, tmp_path: Path) -> None:
    """Its page says ax in m/s²; the recording says -ay in g."""
    rows = [line.split(",") for line in (data_dir / FRICTION).read_text().splitlines()]
    out = rows[0].index("accel")
    path = tmp_path / "ds5.csv"
    path.write_text("\n".join(",".join([*row[:out], *row[out + 1 :]]) for row in rows))
    found = avtorch.check(path)
    assert found.proposal is not None
    assert found.proposal.signals["speed_cmd"].column == "speed_cmd"
    assert "accel" not in found.proposal.signals
    assert "current" not in found.proposal.signals
    (asked,) = (doubt for doubt in found.proposal.doubts if "--map accel=" in doubt)
    assert "imu_ax_g is named so but moves otherwise" in asked
    assert "imu_ay_g moves so" in asked
    assert main(["check", str(path), "--map", "accel=imu_ay_g", "--yes", "--quiet"]) == 0
    log, right = Log.read(path), Log.read(data_dir / FRICTION)
    assert log.accel is not None
    assert right.accel is not None
    assert np.corrcoef(log.accel, right.accel)[0, 1] > 0.999
    assert log.accel.std() == pytest.approx(right.accel.std(), rel=0.01)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "command"), [(UCAR, "throttle"), (FRICTION, "speed_error")])
def test_estimate_and_diagnose_answer_by_a_map(name: str, command: str, data_dir: Path, tmp_path: Path) -> None:
    log = str(data_dir / name)
    quick = ["--estimator", "ekf", "--window", "10", "--quiet"]
    assert main(["estimate", log, *quick, "--out", str(tmp_path / "estimate")]) == 0
    answer = json.loads((tmp_path / "estimate" / "estimates.json").read_text())
    assert f"a map of {command}" in answer["command"]
    assert any(window["used"] for window in answer["windows"])
    few = ["--effects", "sensor_bias,dead_time,sensor_lag", "--no-pairs", "--posterior", "laplace", "--quiet"]
    assert main(["diagnose", log, *few, "--out", str(tmp_path / "diagnose")]) == 0
    found = json.loads((tmp_path / "diagnose" / "diagnosis.json").read_text())
    assert any(f"a map of {command}" in note for note in found["notes"])
