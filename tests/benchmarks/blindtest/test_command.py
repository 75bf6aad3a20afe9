"""`python -m benchmarks.blindtest`: its files, how it goes on, and one line for whatever it cannot use."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
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


@pytest.fixture
def laps(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    monkeypatch.chdir(tmp_path)
    names = ["lap1.csv", "lap2.csv"]
    for lap, name in enumerate(names, 1):
        time = np.arange(400) / 20
        command = np.sin(0.5 * lap * time)
        log = Log.from_arrays(time=time, accel_cmd=command, accel=0.9 * command, speed=15 + np.cumsum(command) / 20)
        log.write(name)
    return names


def test_effects_in_front_of_recordings(
    quick: list[str], laps: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "x"
    line = ["--background", *laps, "--seed", "4", "--effects", "dead_time,gust", "--out", str(out)]
    command.main(line)
    told = " ".join(capsys.readouterr().out.split())
    assert "nothing: unknown or none." in told
    assert "0/12" in told
    assert "lap1.csv, untouched: none." in told
    assert {"background.json", "trial.json", "truth", "answers"} == {p.name for p in out.iterdir()}
    answer = json.loads((out / "background.json").read_text(encoding="utf-8"))
    assert [(one["size"], one["trials"]) for one in answer["by_size"]] == [(0.5, 4), (0.8, 4), (1.25, 4)]
    assert answer["totals"]["nothing_named"] == answer["totals"]["trials"] == len(quick) - 2 == 12
    command.main(line)
    assert len(quick) == 14
    one = ["--signals", "speed", "--sizes", "1", "--effects", "dead_time,sensor_bias", "--out", str(tmp_path / "y")]
    command.main(["--background", laps[0], "--seed", "4", *one])
    assert "recording: sensor_bias." in " ".join(capsys.readouterr().out.split()).replace(
        "Not put in front of every log, where they would change nothing", "recording"
    )


@pytest.mark.parametrize(
    ("line", "told"),
    [
        (["--background", "a.csv", "--n", "3"], "--n does not go with --background"),
        (["--background", "a.csv", "--recorder", "ordinary"], "--recorder does not go with --background"),
        (["--background", "a.csv", "--sizes", "big"], "--sizes: found 'big'"),
        (["--n", "1", "--draws", "2"], "--draws does not go without --background"),
        (["--n", "1", "--mix", "none=0.5,several=0.4"], "--mix: found 'none=0.5,several=0.4'"),
        (["--n", "1", "--mix", "none=0.5,none=0.5"], "--mix: found 'none=0.5,none=0.5'"),
        (["--n", "1", "--mix", "none=x"], "--mix: found 'none=x'"),
        ([], "needs --n, or --background"),
    ],
)
def test_what_does_not_go_together_is_refused(line: list[str], told: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as end:
        command.main([*line, "--seed", "1"])
    assert end.value.code == 2
    assert told in capsys.readouterr().err
