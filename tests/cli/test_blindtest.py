"""`avtorch blindtest`: its files, resumption, and one line for whatever it cannot use."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from avtorch import trial
from avtorch.cli import main
from avtorch.io import Log


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """In place of the diagnosis one that answers `none` at once; the list names the cases it was given."""
    asked: list[str] = []

    def says_none(log: Log) -> dict[str, Any]:
        asked.append(log.name)
        return trial.reply(log, {"none": 1.0}, why="always")

    monkeypatch.setattr(trial, "avtorch", says_none)
    return asked


@pytest.mark.slow
def test_writes_answer_and_picture_and_goes_on(
    quick: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "deep/er"
    line = ["blindtest", "--seed", "3", "--out", str(out), "--rivals", "none"]
    assert main([*line, "--n", "3"]) == 0
    told = capsys.readouterr().out
    assert "3 cases: " in told
    assert "aim" in told
    assert {"blindtest.json", "confusion.png", "trial.json", "truth", "answers"} == {p.name for p in out.glob("[!.]*")}
    assert main([*line, "--n", "4"]) == 2
    assert "--resume" in capsys.readouterr().err
    assert main([*line, "--n", "4", "--resume", "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer == json.loads((out / "blindtest.json").read_text(encoding="utf-8"))
    assert answer["cases"] == 4
    assert list(answer["baselines"]) == ["random_guess"]
    assert quick == [f"case_{i:05d}" for i in range(4)]


def test_interruption_says_how_to_go_on(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def stopped(log: Log) -> dict[str, Any]:
        raise KeyboardInterrupt

    monkeypatch.setattr(trial, "avtorch", stopped)
    assert main(["blindtest", "--n", "2", "--seed", "3", "--rivals", "none", "--out", str(tmp_path / "x")]) == 130
    assert "--resume goes on" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (["--n", "0"], "--n: found 0"),
        (["--workers", "0"], "--workers: found 0"),
        (["--rivals", "oracle"], "rivals: found 'oracle'"),
        (["--signals", "jerk"], "--signals"),
        (["--seed", "-1"], "--seed: found -1"),
    ],
)
def test_bad_arguments_are_one_line(
    change: list[str], told: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    given = {"--n": "1", "--seed": "1", "--out": str(tmp_path / "out")} | {change[0]: change[1]}
    assert main(["blindtest", *(f"{key}={value}" for key, value in given.items())]) == 2
    said = capsys.readouterr().err
    assert told in said
    assert said.count("\n") == 1
    assert not (tmp_path / "out").exists()
