"""One process at a time in `--out`."""

from __future__ import annotations

import inspect
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from avtorch.cli.app import alone_in_out, app
from avtorch.io import sole_use

COMMANDS = {"run", "estimate", "diagnose", "compare", "fleet", "stability", "validate", "paper"}


def test_every_command_that_writes_holds_its_folder() -> None:
    commands = {name: app[name].default_command for name in app if not name.startswith("-")}
    # check writes one small file beside the log, whole or not at all; check-simulator writes nothing; watch appends to
    # a file, and holds the folder of its states (tests/live/test_command.py); app runs commands that hold theirs
    for other in ("app", "check", "check-simulator", "watch"):
        del commands[other]
    assert set(commands) == COMMANDS
    for command in commands.values():
        assert command is not None
        assert command.__code__ is alone_in_out(lambda out: None).__code__
        assert "out" in inspect.signature(command).parameters


ARGUMENTS = {
    "run": ["run"],
    "estimate": ["estimate", "drive.csv"],
    "diagnose": ["diagnose", "drive.csv"],
    "compare": ["compare", "before.csv", "after.csv"],
    "fleet": ["fleet", "logs"],
    "stability": ["stability"],
    "validate": ["validate"],
    "paper": ["paper"],
    "watch": ["watch", "drive.csv"],
}


@pytest.mark.parametrize("url", ["s3://bucket/out", "file:///tmp/out"])
@pytest.mark.parametrize("command", [*ARGUMENTS, "watch --state"])
def test_a_url_for_the_folder_is_refused(
    command: str, url: str, tmp_path: Path, refused: Callable[[list[str]], str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert set(ARGUMENTS) == {*COMMANDS, "watch"}
    monkeypatch.chdir(tmp_path)
    (tmp_path / "drive.csv").write_text("time,accel_cmd,accel\n")
    option = "--state" if command == "watch --state" else "--out"
    told = refused([*ARGUMENTS[command.split()[0]], option, url])
    assert f"{option}: found '{url}'" in told
    assert "of this machine" in told
    assert [path.name for path in tmp_path.iterdir()] == ["drive.csv"]


def test_a_second_process_gets_the_name_of_the_first(tmp_path: Path) -> None:
    out = tmp_path / "out"
    line = [sys.executable, "-m", "avtorch.cli", "stability", "--quiet", "--out", str(out)]
    with sole_use(out, work="avtorch diagnose"):
        second = subprocess.run(line, capture_output=True, text=True, check=False)
    assert second.returncode == 2
    assert second.stdout == ""
    assert second.stderr.count("\n") == 1
    assert f"avtorch: {out}: in use by avtorch diagnose (pid {os.getpid()} on " in second.stderr
    assert "needs another folder" in second.stderr
    assert not out.exists()


def test_within_a_command_the_folder_is_held_and_free_after_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    seen: list[list[str]] = []

    def command(*, out: Path | None, fails: bool = False) -> None:
        seen.append([] if out is None else [p.name for p in out.iterdir()])
        if fails:
            raise KeyboardInterrupt

    held = alone_in_out(command)
    held(out=tmp_path / "out")
    held(out=None)
    with pytest.raises(KeyboardInterrupt):
        held(out=tmp_path / "out", fails=True)
    assert seen == [[".avtorch.lock"], [], [".avtorch.lock"]]
    assert list(tmp_path.iterdir()) == []
    assert capsys.readouterr() == ("", "")


def test_where_there_are_no_locks_a_line_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    import fcntl

    def none(*_: Any) -> None:
        raise OSError(38, "Function not implemented")

    monkeypatch.setattr(fcntl, "flock", none)
    alone_in_out(lambda out: None)(out=tmp_path / "out")
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert "has no locks; keep other runs out of this folder" in said
