"""`avtorch estimate` while it works: progress in lines."""

from __future__ import annotations

import pytest

from avtorch.display import progress


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
