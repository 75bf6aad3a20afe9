"""`avtorch blindtest`: its files, resumption, and one line for whatever it cannot use."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from avtorch import trial
from avtorch.cli import main
from avtorch.io import Log, read_sealed
from avtorch.trial.folder import TRIAL, TRUTH


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


def test_an_ordinary_recorder_is_a_setting_of_the_trial(
    quick: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "x"
    line = ["blindtest", "--n", "1", "--seed", "4", "--rivals", "none", "--out", str(out)]
    assert main([*line, "--recorder", "ordinary"]) == 0
    capsys.readouterr()
    settings = read_sealed(out / "trial.json", schema=TRIAL).content
    assert settings["draw"] == {"recorder": "ordinary"}
    truth = read_sealed(out / "truth" / "case_00000.json", schema=TRUTH).content["truth"]
    assert 0.02 <= truth["recorder"]["speed_lag_s"] <= 0.08
    answer = json.loads((out / "blindtest.json").read_text(encoding="utf-8"))
    assert answer["draw"] == {"recorder": "ordinary"}
    assert main([*line, "--resume"]) == 2
    assert "trial with draw {'recorder': 'ordinary'}; found {}" in capsys.readouterr().err


def test_a_mix_is_a_setting_and_few_cases_are_reported(
    quick: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    line = ["blindtest", "--n", "2", "--seed", "4", "--rivals", "none", "--out", str(tmp_path / "x")]
    assert main([*line, "--mix", "none"]) == 0
    told = " ".join(capsys.readouterr().out.split())
    answer = json.loads((tmp_path / "x" / "blindtest.json").read_text(encoding="utf-8"))
    assert answer["mix"] == {"none": 1.0}
    needed = answer["needed"]["false_alarm"]
    assert f"Too few cases for intervals of ± 5 points, which take {needed} none (of 2)" in told
    assert main([*line, "--resume"]) == 2
    assert "mix" in capsys.readouterr().err


@pytest.fixture
def laps(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    # short names: the terminal wraps long ones
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
    line = ["blindtest", "--background", *laps, "--seed", "4", "--effects", "dead_time,gust", "--out", str(out)]
    assert main(line) == 0
    told = capsys.readouterr().out
    assert "nothing: unknown or none." in " ".join(told.split())
    assert "0/12" in told
    assert "lap1.csv, untouched: none." in told
    assert {"background.json", "trial.json", "truth", "answers"} == {p.name for p in out.glob("[!.]*")}
    answer = json.loads((out / "background.json").read_text(encoding="utf-8"))
    assert answer["sizes"] == [0.5, 0.8, 1.25]
    assert [(one["size"], one["trials"]) for one in answer["by_size"]] == [(0.5, 4), (0.8, 4), (1.25, 4)]
    needed = answer["totals"]["needed"]["held"]
    assert f"± 5 points: 12, which take some {needed}" in " ".join(told.split())
    assert answer["totals"]["nothing_named"] == answer["totals"]["trials"] == len(quick) - 2 == 12
    assert main(line) == 2
    assert "--resume" in capsys.readouterr().err
    assert main([*line, "--resume", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["totals"] == answer["totals"]
    assert len(quick) == 14
    assert main([*line, "--resume", "--sizes", "1"]) == 2
    assert "sizes" in capsys.readouterr().err
    one = ["--signals", "speed", "--sizes", "1", "--effects", "dead_time,sensor_bias", "--out", str(tmp_path / "y")]
    assert main(["blindtest", "--background", laps[0], "--seed", "4", *one]) == 0
    assert "nothing: sensor_bias." in " ".join(capsys.readouterr().out.split())


@pytest.mark.parametrize(
    ("line", "told"),
    [
        (["--background", "no.csv"], "no.csv"),
        (["--background", "LAP", "--n", "3"], "--n: found 3 with --background"),
        (["--background", "LAP", "--rivals", "none"], "--rivals: found none with --background"),
        (["--background", "LAP", "--recorder", "ordinary"], "--recorder: found ordinary with --background"),
        (["--background", "LAP", "--mix", "several"], "--mix: found several with --background"),
        (["--background", "LAP", "--draws", "0"], "--draws: found 0"),
        (["--background", "LAP", "--sizes", "big"], "--sizes: found 'big'"),
        (["--background", "LAP", "--sizes", "-1"], "sizes: found -1"),
        (["--background", "LAP", "--effects", "wings"], "effects: found wings"),
        (["--n", "1", "--sizes", "1"], "--sizes: found '1' without --background"),
        (["--n", "1", "--effects", "gust"], "--effects: found 'gust' without --background"),
        (["--n", "1", "--draws", "2"], "--draws: found '2' without --background"),
        (["--n", "1", "--mix", "many"], "--mix: found 'many'"),
        (["--n", "1", "--mix", "none=0.5,several=0.4"], "--mix: found 'none=0.5,several=0.4'"),
        (["--n", "1", "--mix", "none=0.5,none=0.5"], "--mix: found 'none=0.5,none=0.5'"),
        (["--n", "1", "--mix", "none=x"], "--mix: found 'none=x'"),
        ([], "--n: missing"),
        (["--n", "1", "--recorder", "poor"], "--recorder"),
    ],
)
def test_what_does_not_go_together_is_one_line(
    line: list[str], told: str, laps: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    line = [laps[0] if word == "LAP" else word for word in line]
    assert main(["blindtest", *line, "--seed", "1", "--out", str(tmp_path / "out")]) == 2
    said = capsys.readouterr().err
    assert told in said
    assert said.count("\n") == 1
    assert not (tmp_path / "out").exists()


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
