"""`python -m benchmarks.blindtest`: its files, how it goes on, and one line for whatever it cannot use."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from avtorch.errors import InputError
from avtorch.io import Log
from benchmarks.blindtest import __main__ as command
from benchmarks.blindtest.reply import reply


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """In place of the diagnosis one that answers `none` at once; the list names the cases it was given."""
    asked: list[str] = []

    def says_none(log: Log) -> dict[str, Any]:
        asked.append(log.name)
        return reply(log, {"none": 1.0}, why="always")

    monkeypatch.setattr(command, "avtorch", says_none)
    return asked


@pytest.mark.slow
def test_writes_answer_and_picture_and_goes_on(
    quick: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "deep/er"
    line = ["--seed", "3", "--out", str(out), "--rivals", "none", "--mix", "none", "--recorder", "ordinary"]
    command.main([*line, "--n", "2"])
    told = " ".join(capsys.readouterr().out.split())
    assert {"blindtest.json", "confusion.png", "trial.json", "truth", "answers"} == {p.name for p in out.iterdir()}
    answer = json.loads((out / "blindtest.json").read_text(encoding="utf-8"))
    assert "2 cases: " in told
    needed = answer["needed"]["false_alarm"]
    assert f"Too few cases for intervals of ± 5 points, which take {needed} none (of 2)" in told
    truth = json.loads((out / "truth" / "case_00000.json").read_text(encoding="utf-8"))
    assert 0.02 <= truth["recorder"]["speed_lag_s"] <= 0.08
    command.main([*line, "--n", "3"])
    answer = json.loads((out / "blindtest.json").read_text(encoding="utf-8"))
    assert (answer["cases"], answer["mix"], answer["draw"]) == (3, {"none": 1.0}, {"recorder": "ordinary"})
    assert list(answer["baselines"]) == ["random_guess"]
    assert quick == [f"case_{i:05d}" for i in range(3)]
    with pytest.raises(InputError, match="holds a trial with draw"):
        command.main(["--n", "3", *line[:-2]])


@pytest.mark.parametrize(
    ("line", "told"),
    [
        (["--n", "1", "--mix", "none=0.5,several=0.4"], "--mix: found 'none=0.5,several=0.4'"),
        (["--n", "1", "--mix", "none=0.5,none=0.5"], "--mix: found 'none=0.5,none=0.5'"),
        (["--n", "1", "--mix", "none=x"], "--mix: found 'none=x'"),
        ([], "required: --n"),
    ],
)
def test_what_is_wrong_is_refused(line: list[str], told: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as end:
        command.main([*line, "--seed", "1"])
    assert end.value.code == 2
    assert told in capsys.readouterr().err
