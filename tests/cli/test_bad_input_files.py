"""Commands given what is no log: exit code 2 and one printable line, at once."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest

from avtorch.cli.app import main


@pytest.mark.parametrize("command", ["estimate", "diagnose", "compare", "run"])
def test_no_command_waits_or_echoes(command: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    os.mkfifo(tmp_path / "pipe.csv")
    (tmp_path / "j.csv").write_text("{" + '"a": 1, ' * 12_000 + "}")
    (tmp_path / "mark.csv").write_bytes(b"\xef\xbb\xbf")
    (tmp_path / "\x1b[2J\n.csv").write_text("a\x1b[2J\u202e,b\n1,2\n")
    names = ["pipe.csv", "j.csv", "mark.csv", "\x1b[2J\n.csv", "\x1b[2J\n", 300 * "x" + ".csv", "a\0.csv", "\udcff"]
    for log in ["/dev/zero", "/etc/passwd", *(str(tmp_path / name) for name in names)]:
        logs = ["--leader", log] if command == "run" else [log, log] if command == "compare" else [log]
        assert main([command, *logs, "--out", str(tmp_path / "out")]) == 2, log
        told = capsys.readouterr()
        assert told.out == ""
        assert told.err.endswith("\n")
        assert told.err[:-1].isprintable(), told.err
        assert len(told.err) < 500


@pytest.mark.parametrize(
    "options",
    [
        ["--accepted", 5000 * "["],
        ["--gains", "\x1b[2J,1,1"],
        ["--gains", "１,1,1"],
        ["--map", "accel=" + 5000 * "x"],
        ["--unit", "speed=\u202e"],
        ["--stamp", 5000 * "x"],
        ["--" + 5000 * "x"],
        ["--window", 5000 * "9x"],
    ],
    ids=lambda options: ascii(options[0][:12]),
)
def test_options_are_not_recited(options: list[str], tmp_path: Path, refused: Callable[[list[str]], str]) -> None:
    (tmp_path / "lap.csv").write_text("time,accel_cmd,accel,speed\n0,1,1,1\n0.1,1,1,1\n")
    assert len(refused(["estimate", str(tmp_path / "lap.csv"), *options, "--out", str(tmp_path / "out")])) < 500
