"""`avtorch check`: what it says, what it writes, and what it leaves alone."""

from __future__ import annotations

import builtins
import json
import sys
from pathlib import Path

import numpy as np
import pytest

from avtorch.cli import main
from avtorch.io import Log


@pytest.fixture
def drive(tmp_path: Path) -> Path:
    time = np.arange(0.0, 40.0, 0.05)
    command = np.sin(0.9 * time) + 0.5 * np.sin(2.1 * time)
    kernel = np.exp(-np.arange(0, 2, 0.05) / 0.3)
    accel = np.convolve(command, kernel / kernel.sum())[: len(time)]
    speed = 20 + np.cumsum(accel) * 0.05
    rows = zip(time, command, 3.6 * speed, strict=True)
    lines = ["t;a_target;speed_kmh", *(";".join(f"{x:.5f}" for x in row) for row in rows)]
    path = tmp_path / "drive.csv"
    path.write_text("\n".join(lines).replace(".", ","), encoding="utf-8")
    return path


def told(capsys: pytest.CaptureFixture[str]) -> str:
    return " ".join(capsys.readouterr().out.split())


def test_nothing_is_written_unasked(drive: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check", str(drive)]) == 0
    words = told(capsys)
    for part in ("separated by semicolons, decimal commas", "a_target", "km/h", "Excitation", "Nothing was written"):
        assert part in words
    assert list(drive.parent.iterdir()) == [drive]


def test_yes_writes_what_the_other_commands_read(drive: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check", str(drive), "--yes"]) == 0
    assert "Next: avtorch estimate" in told(capsys)
    before = drive.with_suffix(".toml").read_bytes()
    assert 15 < float(Log.read(drive).speed.mean()) < 25
    assert main(["check", str(drive), "--yes"]) == 0
    assert f"Read as {drive.with_suffix('.toml')} says" in told(capsys)
    assert drive.with_suffix(".toml").read_bytes() == before


def test_what_cannot_be_read_as_proposed_is_not_written(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A command whose word nobody knows is taken for the acceleration, so that there is none."""
    time = np.arange(0.0, 40.0, 0.05)
    command = np.sin(0.9 * time) + 0.5 * np.sin(2.1 * time)
    accel = np.convolve(command, np.full(8, 1 / 8))[: len(time)]
    rows = zip(time, command, accel, 20 + np.cumsum(accel) * 0.05, strict=True)
    path = tmp_path / "drive.csv"
    path.write_text(
        "\n".join(["t,Zugriff_Beschl,Beschl_laengs,v", *(",".join(f"{x:.4f}" for x in row) for row in rows)])
    )
    assert main(["check", str(path), "--yes"]) == 2
    words = told(capsys)
    assert "Nothing was written" in words
    assert "Next:" not in words
    assert not path.with_suffix(".toml").exists()


@pytest.mark.parametrize(("key", "written"), [("", True), ("y", True), ("n", False), (EOFError(), False)])
def test_one_key_accepts(
    drive: Path,
    key: str | Exception,
    written: bool,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def typed(_: str) -> str:
        if isinstance(key, Exception):
            raise key
        return key

    for stream in (sys.stdin, sys.stdout):
        monkeypatch.setattr(stream, "isatty", lambda: True)
    monkeypatch.setattr(builtins, "input", typed)
    assert main(["check", str(drive)]) == 0
    assert drive.with_suffix(".toml").exists() == written
    capsys.readouterr()


def test_json_is_the_whole_answer(drive: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check", str(drive), "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer["schema"] == "avtorch.check/1"
    assert answer["signals"]["speed"]["unit"] == "km/h"
    assert answer["mapping_needed"]
    assert answer["quality"]["rows"] == 800


def test_a_log_that_cannot_be_read_says_why_after_what_was_seen(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    time = np.arange(0.0, 20.0, 0.05)
    rows = zip(time, 20 + np.sin(time), strict=True)
    path = tmp_path / "drive.csv"
    path.write_text("\n".join(["time,speed", *(f"{t:.3f},{v:.3f}" for t, v in rows)]))
    assert main(["check", str(path)]) == 2
    seen = capsys.readouterr()
    assert "no column looks like the commanded acceleration" in " ".join(seen.out.split())
    assert "column 'accel_cmd' is missing" in seen.err
    assert len(seen.err.splitlines()) == 1


@pytest.mark.parametrize("content", [b"", b"\x00\x01\x02binary", b'{"a": 1}'])
def test_what_is_no_log_is_one_line(tmp_path: Path, content: bytes, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "drive.csv").write_bytes(content)
    assert main(["check", str(tmp_path / "drive.csv")]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1
