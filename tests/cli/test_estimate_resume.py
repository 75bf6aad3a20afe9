"""`avtorch estimate` interrupted or killed, and given again: the answer of an uninterrupted run, to the bit."""

from __future__ import annotations

import io
import json
import shutil
from collections.abc import Callable
from contextlib import redirect_stderr
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from avtorch.cli import main
from avtorch.cli.estimate import STATE as WINDOWS
from avtorch.decision import estimation
from avtorch.io import Log


def two_segments(path: Path) -> str:
    """18 s of speed at 50 Hz in two segments of 10 and 8 s, the second on a clock that starts anew."""
    dt, rng = 0.02, np.random.default_rng(5)
    command = np.repeat(rng.normal(0.0, 1.0, 36), 25)
    accel = np.convolve(command, np.exp(-np.arange(0, 2, dt) / 0.3) * dt / 0.3)[: len(command)]
    speed = 15.0 + np.cumsum(accel) * dt + 0.01 * rng.standard_normal(len(command))
    segment = (np.arange(len(command)) > 499).astype(float)
    time = np.where(segment == 0, np.arange(len(command)), np.arange(len(command)) - 500) * dt
    Log.from_arrays(time=time, accel_cmd=command, speed=speed, segment=segment).write(path)
    return str(path)


def answer(out: Path) -> dict[str, Any]:
    found = json.loads((out / "estimates.json").read_text(encoding="utf-8"))
    found.pop("seconds_per_window")  # a measured time
    found.pop("files")  # a page tells it, too
    return found


def with_each_window(call: Callable[[object], None], monkeypatch: pytest.MonkeyPatch) -> None:
    """The command calls this, too, as a window is done."""
    work = estimation.estimate
    monkeypatch.setattr(estimation, "estimate", partial(work, finished=call))


@pytest.fixture(scope="module")
def begun(tmp_path_factory: pytest.TempPathFactory) -> tuple[list[str], Path]:
    """A command that was interrupted at its sixth window, and its folder."""
    folder = tmp_path_factory.mktemp("begun")
    line = ["estimate", two_segments(folder / "drive.csv"), "--quiet", "--dead-time", "0"]
    out, count, told = folder / "out", 0, io.StringIO()

    def stop(_: object) -> None:
        nonlocal count
        count += 1
        if count == 6:
            raise KeyboardInterrupt

    with pytest.MonkeyPatch.context() as until, redirect_stderr(told):
        with_each_window(stop, until)
        assert main([*line, "--out", str(out)]) == 130
    said = told.getvalue()
    assert said.count("\n") == 1
    assert f"interrupted: finished windows are kept in {out / WINDOWS}" in said
    assert "the same command resumes there" in said
    return line, out


@pytest.fixture
def interrupted(begun: tuple[list[str], Path], tmp_path: Path) -> tuple[list[str], Path]:
    """The same command, and a copy of its folder."""
    line, out = begun
    return line, Path(shutil.copytree(out, tmp_path / "out"))


def test_the_same_command_goes_on_to_the_same_answer(interrupted: tuple[list[str], Path], tmp_path: Path) -> None:
    line, out = interrupted
    assert main([*line, "--out", str(out)]) == 0
    assert main([*line, "--out", str(tmp_path / "whole")]) == 0
    assert answer(out) == answer(tmp_path / "whole")
    used = [w["used"] for w in answer(out)["windows"]]
    assert sum(used) > 5, "the belief has to be carried over the interruption"
    assert not (out / WINDOWS).exists()


@pytest.mark.slow
def test_windows_done_before_are_not_computed_again(
    interrupted: tuple[list[str], Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    line, out = interrupted
    fed: list[float] = []
    feed = estimation.Watch.feed
    monkeypatch.setattr(
        estimation.Watch, "feed", lambda self, time, *a, **k: (fed.append(len(time)), feed(self, time, *a, **k))[1]
    )
    assert main([*line, "--out", str(out)]) == 0
    assert 0 < sum(fed) < 900 - 600, "a row of the six windows that were finished was fed again"


@pytest.mark.slow
def test_a_killed_run_goes_on_from_what_was_written_last(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    line = ["estimate", two_segments(tmp_path / "drive.csv"), "--quiet", "--dead-time", "0"]
    monkeypatch.setattr(estimation, "EVERY_S", 0.0)
    out, killed, seen = tmp_path / "out", tmp_path / "killed", []

    def copied(window: object) -> None:
        seen.append(window)
        if len(seen) == 3:
            killed.mkdir()
            shutil.copy(out / WINDOWS, killed)

    with monkeypatch.context() as until:
        with_each_window(copied, until)
        assert main([*line, "--out", str(out)]) == 0
    assert main([*line, "--out", str(killed)]) == 0
    assert answer(killed) == answer(out)


@pytest.mark.parametrize(
    "more",
    [
        ["--estimator", "map"],
        pytest.param(["--seed", "1"], marks=pytest.mark.slow),
        pytest.param(["--window", "1"], marks=pytest.mark.slow),
        pytest.param(["--tau", "1.2"], marks=pytest.mark.slow),
    ],
)
def test_other_settings_are_refused_in_one_line(
    interrupted: tuple[list[str], Path], refused: Callable[[list[str]], str], more: list[str]
) -> None:
    line, out = interrupted
    told = refused([*line, *more, "--out", str(out)])
    assert f"{out / WINDOWS}: was begun with different settings; needs the same log and settings" in told
    assert "avtorch estimate --no-resume" in told
    assert main([*line, *more, "--no-resume", "--out", str(out)]) == 0


def test_another_log_of_the_same_name_is_refused(
    interrupted: tuple[list[str], Path], tmp_path: Path, refused: Callable[[list[str]], str]
) -> None:
    (command, path, *options), out = interrupted
    other = tmp_path / "drive.csv"
    other.write_text(Path(path).read_text(encoding="utf-8").replace("15.0", "15.1", 1), encoding="utf-8")
    assert "was begun with different log;" in refused([command, str(other), *options, "--out", str(out)])


def test_a_damaged_file_is_refused(interrupted: tuple[list[str], Path], refused: Callable[[list[str]], str]) -> None:
    line, out = interrupted
    content = (out / WINDOWS).read_bytes()
    (out / WINDOWS).write_bytes(content[: len(content) // 2])
    assert "is damaged" in refused([*line, "--out", str(out)])
