"""`avtorch estimate` while it works: windows on the disk as they are done, and progress in lines."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from avtorch import GLVDPlant, Leader, estimate, simulate
from avtorch.cli.estimate import LINES as NAME
from avtorch.cli.estimate import finished_windows
from avtorch.display import progress
from avtorch.errors import InputError
from avtorch.results import window_entry


def test_windows_are_on_the_disk_as_they_are_done_and_gone_with_the_answer(tmp_path: Path) -> None:
    run = simulate(Leader.default(start=50.0, duration=6.0, dt=0.02), plant=GLVDPlant(0.5, 0.9))
    path, seen = tmp_path / NAME, []
    with finished_windows(tmp_path) as write:

        def one(window):
            write(window)
            seen.append(len(path.read_text(encoding="utf-8").splitlines()))

        found = estimate(run.log(), estimator="map", finished=one)
        lines = path.read_text(encoding="utf-8").splitlines()
    assert seen == [1, 2, 3]
    assert [json.loads(line) for line in lines] == [window_entry(w) for w in found.windows]
    assert not path.exists()


def test_an_interruption_leaves_the_windows_done_so_far(tmp_path: Path) -> None:
    run = simulate(Leader.default(start=50.0, duration=6.0, dt=0.02), plant=GLVDPlant(0.5, 0.9))

    def stop(window):
        write(window)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt), finished_windows(tmp_path) as write:
        estimate(run.log(), estimator="map", finished=stop)
    assert len((tmp_path / NAME).read_text(encoding="utf-8").splitlines()) == 1


def test_a_place_that_cannot_be_written_is_refused_in_one_line(tmp_path: Path) -> None:
    (tmp_path / NAME).mkdir()
    run = simulate(Leader.default(start=50.0, duration=4.0, dt=0.02), plant=GLVDPlant(0.5, 0.9))
    with pytest.raises(InputError, match=NAME), finished_windows(tmp_path) as write:
        estimate(run.log(), estimator="map", finished=write)


def lines(title: str, calls: list[tuple], times: list[float], monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """What is printed, every 10 s at most, of calls at these times after the beginning."""
    clock, said = iter([0.0, *times]), []
    monkeypatch.setattr(progress.time, "monotonic", lambda: next(clock))
    step = progress.Steps(title, progress.Lines(said.append), 10.0)
    for told in calls:
        step(*told)
    return said


def test_lines_tell_the_share_and_the_time_left(monkeypatch: pytest.MonkeyPatch) -> None:
    calls = [(done, 100) for done in (10, 30, 40, 50)]
    assert lines("Estimating", calls, [4.0, 12.0, 15.0, 25.0], monkeypatch) == [
        "Estimating: 30 %, about 28 s left",
        "Estimating: 50 %, about 25 s left",
    ]


def test_lines_name_the_stage_where_there_are_several(monkeypatch: pytest.MonkeyPatch) -> None:
    said = lines("Diagnosing", [("pairs", 250, 1000)], [20.0], monkeypatch)
    assert said == ["Diagnosing: 25 %, about 60 s left (pairs)"]


def test_what_comes_first_tells_its_own_time_and_does_not_count(monkeypatch: pytest.MonkeyPatch) -> None:
    """A simulator of 31 s, driven before any step of the diagnosis, made that seem to take half an hour."""
    calls = [("driving the simulator, about 31 s", 0, 1000), ("simulator", 0, 1000), ("single effects", 200, 1000)]
    assert lines("Diagnosing", calls, [0.1, 31.0, 51.0], monkeypatch) == [
        "Diagnosing: driving the simulator, about 31 s",
        "Diagnosing: 20 %, about 80 s left (single effects)",
    ]
