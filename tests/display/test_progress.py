"""The bar of a long call: where it stands, what it says, that it goes, and who may ask for it; lines in its place."""

from __future__ import annotations

import io
import sys
from types import SimpleNamespace
from typing import Any

import pytest

import avtorch
from avtorch.display import progress, progress_bar, show
from avtorch.experiment import next_experiment
from avtorch.fleet import run_fleet
from avtorch.follower import diagnose_follower
from avtorch.paper import reproduce


class Output:
    """Of a cell; `seen` is what it held, in order."""

    def __init__(self, data: dict[str, str]) -> None:
        self.seen = [data]

    def update(self, data: dict[str, str], raw: bool) -> None:
        assert raw
        self.seen.append(data)


@pytest.fixture
def outputs(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """What a notebook displays; bars at once and at each step."""
    found: list[Any] = []

    def display(data: Any, raw: bool = False, display_id: bool = False) -> Output:
        assert raw == display_id
        found.append(Output(data))
        return found[-1]

    kernel = SimpleNamespace(kernel=None)
    monkeypatch.setitem(sys.modules, "IPython", SimpleNamespace(get_ipython=lambda: kernel))
    monkeypatch.setitem(sys.modules, "IPython.display", SimpleNamespace(display=display))
    at_once(monkeypatch)
    return found


def at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(progress, "AFTER_S", 0.0)
    monkeypatch.setattr(progress, "_EVERY_S", 0.0)


def log(seconds: float = 14.0) -> avtorch.Log:
    return avtorch.simulate(avtorch.Leader.default(start=50.0, duration=seconds, dt=0.05)).log()


def test_in_a_notebook_the_bar_moves_and_leaves_an_empty_output(outputs: list[Output]) -> None:
    with progress_bar("a <b>") as step:
        step("first", 0, 4)
        step("second", 1, 4)
    (output,) = outputs
    html = [data["text/html"] for data in output.seen]
    assert "<progress" in html[0]
    assert "a &lt;b&gt;: first" in html[0]
    assert 'value="0.250"' in html[1]
    assert " s left" in html[1]
    assert output.seen[-1] == {"text/html": "", "text/plain": ""}


def test_a_bar_goes_when_the_work_fails(outputs: list[Output]) -> None:
    def work() -> None:
        with progress_bar("work") as step:
            step(1, 2)
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        work()
    assert outputs[0].seen[-1]["text/html"] == ""


def test_a_bar_within_a_bar_is_not_shown(outputs: list[Output]) -> None:
    with progress_bar("outer") as outer, progress_bar("inner") as inner:
        outer(1, 2)
        inner(1, 2)
    assert len(outputs) == 1
    assert "outer" in outputs[0].seen[0]["text/html"]


def test_what_is_quick_shows_no_bar(outputs: list[Output], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(progress, "AFTER_S", 60.0)
    with progress_bar("quick") as step:
        step(1, 2)
    assert outputs == []


@pytest.mark.parametrize(("asked", "bars"), [(None, 1), (True, 1), (False, 0), (lambda done, of: None, 0)])
def test_who_asks_for_a_bar_in_a_notebook(asked: Any, bars: int, outputs: list[Output]) -> None:
    avtorch.estimate(log(), progress=asked)
    assert len(outputs) == bars


@pytest.mark.parametrize("terminal", [True, False])
@pytest.mark.parametrize("asked", [None, True])
def test_in_a_terminal_only_where_it_is_asked_for(
    asked: bool | None, terminal: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    at_once(monkeypatch)
    stream = io.StringIO()
    monkeypatch.setattr(stream, "isatty", lambda: terminal)
    monkeypatch.setattr(sys, "stderr", stream)
    avtorch.estimate(log(), progress=asked)
    assert ("estimate" in stream.getvalue()) is (terminal and asked is True)


@pytest.mark.parametrize(
    "long",
    [
        avtorch.compare,
        avtorch.compare_simulators,
        avtorch.diagnose,
        avtorch.estimate,
        avtorch.validate,
        diagnose_follower,
        next_experiment,
        reproduce,
        run_fleet,
    ],
)
def test_long_calls_offer_a_bar(long: Any) -> None:
    layers = [long]
    while hasattr(layers[-1], "__wrapped__"):  # an argument's old name may be a layer of its own
        layers.append(layers[-1].__wrapped__)
    assert progress.shows_progress(lambda: None).__code__ in [layer.__code__ for layer in layers]


def test_a_drive_under_a_supervisor_shows_one_too(outputs: list[Output]) -> None:
    loop = avtorch.ClosedLoop(avtorch.Leader.default(), plant=avtorch.GLVDPlant(0.3, 1.0), seeds=[0])
    supervisor = avtorch.Supervisor(loop)
    supervisor.run(2.0)
    supervisor.run(4.0)  # goes on where the first ended
    assert len(outputs) == 2
    shares = [data["text/plain"].split()[0] for data in outputs[1].seen[:-1]]
    assert shares == ["50%", "100%"]
    supervisor.run(2.0, progress=False)
    assert len(outputs) == 2


def test_an_answer_is_displayed_in_a_notebook_and_printed_elsewhere(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    show("an answer")
    assert capsys.readouterr().out == "an answer\n"
    shown: list[Any] = []
    kernel = SimpleNamespace(kernel=None)
    monkeypatch.setitem(sys.modules, "IPython", SimpleNamespace(get_ipython=lambda: kernel))
    monkeypatch.setitem(sys.modules, "IPython.display", SimpleNamespace(display=shown.append))
    show("an answer", 2)
    assert shown == ["an answer", 2]
    assert capsys.readouterr().out == ""


def told_in_lines(title: str, calls: list[tuple], times: list[float], monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """What is printed, every 10 s at most, of calls at these times after the beginning."""
    clock, said = iter([0.0, *times]), []
    monkeypatch.setattr(progress.time, "monotonic", lambda: next(clock))
    step = progress.Steps(title, progress.Lines(said.append), 10.0)
    for told in calls:
        step(*told)
    return said


def test_lines_tell_the_share_and_the_time_left(monkeypatch: pytest.MonkeyPatch) -> None:
    calls = [(done, 100) for done in (10, 30, 40, 50)]
    assert told_in_lines("Estimating", calls, [4.0, 12.0, 15.0, 25.0], monkeypatch) == [
        "Estimating: 30 %, about 28 s left",
        "Estimating: 50 %, about 25 s left",
    ]


def test_lines_name_the_stage_where_there_are_several(monkeypatch: pytest.MonkeyPatch) -> None:
    said = told_in_lines("Diagnosing", [("pairs", 250, 1000)], [20.0], monkeypatch)
    assert said == ["Diagnosing: 25 %, about 60 s left (pairs)"]


def test_what_comes_first_tells_its_own_time_and_does_not_count(monkeypatch: pytest.MonkeyPatch) -> None:
    """A simulator of 31 s, driven before any step of the diagnosis, made that seem to take half an hour."""
    calls = [("driving the simulator, about 31 s", 0, 1000), ("simulator", 0, 1000), ("single effects", 200, 1000)]
    assert told_in_lines("Diagnosing", calls, [0.1, 31.0, 51.0], monkeypatch) == [
        "Diagnosing: driving the simulator, about 31 s",
        "Diagnosing: 20 %, about 80 s left (single effects)",
    ]
