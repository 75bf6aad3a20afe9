"""`avtorch diagnose` from a file to the page without stubs: Unix time, overrides, a second run."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from avtorch.cli import main
from avtorch.io import Log
from tests.bars import BAR
from tests.overridden import taken_over

EPOCH = 1.7e9


@pytest.fixture
def drive(tmp_path: Path, rotating_seed: int) -> Path:
    """50 s of a car 0.2 s late, stamped by a Unix clock; a driver acts against the command for 2 s of them."""
    rng = np.random.default_rng(rotating_seed)
    log = taken_over(seconds=50.0, overrides=[(24.0, 26.0)], rng=rng, delay_s=0.2)
    path = tmp_path / "drive.csv"
    columns = {"accel_cmd": log.accel_cmd, "accel": log.accel, "speed": log.speed, "engaged": log.engaged.astype(int)}
    Log.from_arrays(time=log.time + EPOCH, **columns).write(path)
    return path


@pytest.mark.statistical
def test_from_a_file_to_the_page(
    drive: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    out, estimates = tmp_path / "out", tmp_path / "estimates.json"
    log = Log.read(drive)
    windows = [{"end_s": log.epoch_s + 30.0, "alerts": ["stability"]}]
    of_log = {
        "schema": "avtorch.estimates/1",
        "epoch_s": log.epoch_s,
        "quality": {"rows": log.rows},
        "windows": windows,
    }
    estimates.write_text(json.dumps(of_log), encoding="utf-8")
    command = [
        "diagnose",
        str(drive),
        "--estimates",
        str(estimates),
        "--effects",
        "dead_time,sensor_bias",
        "--no-pairs",
        "--posterior",
        "laplace",
        "--out",
        str(out),
        "--verbose",
    ]
    assert main(command) == 0
    told = " ".join(capsys.readouterr().out.split())
    assert "2023-11-14" in told
    assert "1 return to engaged" in told
    assert "late (dead_time)" in told
    answer = json.loads((out / "diagnosis.json").read_text(encoding="utf-8"))
    assert answer["verdict"]["names"] == ["dead_time"]
    delay = next(e for e in answer["effects"] if e["name"] == "dead_time")["parameters"]["delay_s"]
    assert abs(delay["mean"] - 0.2) < BAR * delay["sd"]
    assert answer["not_tried"]["pairs"] == "none"
    assert "aerodynamic_drag" in answer["not_tried"]["effects"]
    page = (out / "report.html").read_text(encoding="utf-8")
    assert "dead_time" in page
    assert "alarms of the monitor (stability at 30.0 s)" in page
    # the same command again goes on from kept fits, to the same answer
    before = json.loads((out / "diagnosis.json").read_text(encoding="utf-8"))
    # its pictures were drawn once
    monkeypatch.setattr("avtorch.report.page.inline_svg", lambda *_: "")
    assert main([*command[:-1], "--quiet"]) == 0
    again = json.loads((out / "diagnosis.json").read_text(encoding="utf-8"))
    assert before.pop("files").keys() == again.pop("files").keys()  # a page tells when it was made
    assert again == before
