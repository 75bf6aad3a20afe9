"""Faults while a command writes: each file is whole, of the earlier answer or the new; a mixed set is recognised.

Stubs replace computation and drawing, so that a command runs in milliseconds and its writing can fail at every call;
argument parsing, checks and writing are the command's own. `of` selects one of two answers of the stubs. The commands
not here write by the same `answer_set`, of which `io/test_answer_set.py` sweeps every call: their tests show that all
their files are of one set.
"""

from __future__ import annotations

import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest

import avtorch.decision.estimation
import avtorch.experiment
import avtorch.gap.compare
import avtorch.plots.style
import avtorch.report
import avtorch.report.comparison
import avtorch.report.diagnosis
import avtorch.report.estimates
import avtorch.results
import avtorch.vehicle.stability
from avtorch.cli import main
from avtorch.gap import DeadTime, plant
from tests.cli.test_diagnose import answer, columns, write
from tests.faulty_disk import disk, fails, old_or_new, tree, visible


class Command:
    """A command with stubs for its work: the command line for the `old` answer, and the one for the `new`."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
        self.monkeypatch, self.tmp_path, self.out = monkeypatch, tmp_path, tmp_path / "out"
        self.of = "old"
        self.lines: dict[str, list[str]] = {}
        for name in dir(avtorch.plots):
            if name.endswith("_figure"):
                self.stand_in(avtorch.plots, name, lambda *_, name=name, **__: f"{name} of {self.of}")
        self.stand_in(avtorch.plots.style, "_png", lambda figure: figure.encode())
        monkeypatch.setattr("os.fsync", lambda handle: None)

    def stand_in(self, module: Any, name: str, function: Callable) -> None:
        self.monkeypatch.setattr(module, name, function)

    def once(self, module: Any, name: str) -> None:
        """Compute each of the two answers once."""
        function, kept = getattr(module, name), {}

        def stand_in(*args: Any, **more: Any) -> Any:
            if self.of not in kept:
                kept[self.of] = function(*args, **more)
            return kept[self.of]

        self.stand_in(module, name, stand_in)

    def run(self, which: str) -> int:
        self.of = which
        return main([*self.lines[which], "--quiet", "--out", str(self.out)])


def stability(c: Command) -> None:
    c.lines = {"old": ["stability"], "new": ["stability", "--T", "0.7"]}
    c.once(avtorch.results, "stability_answer")
    c.once(avtorch.vehicle.stability, "region")


def estimate(c: Command) -> None:
    line = ["estimate", write(c.tmp_path / "drive.csv", **columns()), "--estimator", "map"]
    c.lines = {"old": line, "new": [*line, "--tau", "1.2"]}
    c.once(avtorch.decision.estimation, "estimate")
    c.stand_in(avtorch.report.estimates, "estimates_html", lambda *_, **__: f"page of {c.of}")


def diagnose(c: Command) -> None:
    """The new answer has a plant, the old one has a manoeuvre besides what both have."""
    line = ["diagnose", write(c.tmp_path / "drive.csv", **columns())]
    c.lines = {"old": line, "new": line}
    given = {"old": {"plant": None}, "new": {"plant": plant([DeadTime(0.182)])}}
    module = ModuleType("avtorch.gap.diagnose")
    module.diagnose = lambda logs, **_: answer(logs, **given[c.of])  # type: ignore[attr-defined]
    c.monkeypatch.setitem(sys.modules, "avtorch.gap.diagnose", module)
    manoeuvre = SimpleNamespace(time=np.zeros(1), command=np.zeros(1), speed=np.zeros(1))
    ahead = {"old": SimpleNamespace(manoeuvre=manoeuvre, to_dict=lambda: None), "new": None}
    c.stand_in(avtorch.experiment, "next_experiment", lambda *_, **__: ahead[c.of])
    c.stand_in(sys.modules["avtorch.report.diagnosis"], "report_html", lambda *_, **__: f"page of {c.of}")


def comparison(c: Command) -> None:
    log = write(c.tmp_path / "drive.csv", **columns())
    c.lines = {of: ["compare", log, log] for of in ("old", "new")}
    told = lambda *_, **__: SimpleNamespace(why=c.of, car={}, gap={}, cause=None, to_dict=lambda: {"why": c.of})  # noqa: E731
    c.stand_in(avtorch.gap.compare, "compare", told)
    c.stand_in(avtorch.report.comparison, "comparison_html", lambda *_, **__: f"page of {c.of}")


QUICK = [stability, comparison]
COMMANDS = [*QUICK, estimate, diagnose]


@pytest.fixture(
    params=[pytest.param(c, marks=[] if c in QUICK else [pytest.mark.slow], id=c.__name__) for c in COMMANDS]
)
def command(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Command:
    """With the old answer in its folder, which is kept beside it to begin from again."""
    made = Command(monkeypatch, tmp_path)
    request.param(made)
    assert made.run("old") == 0
    shutil.copytree(made.out, tmp_path / "before", symlinks=True)
    return made


class Answers:
    """What the folder holds before and after."""

    def __init__(self, command: Command) -> None:
        self.command = command
        self.old = self.seen()
        assert command.run("new") == 0
        self.new = self.seen()
        assert self.old
        assert self.old != self.new
        self.again()
        (self.json,) = {name for name in self.old.keys() | self.new.keys() if name.endswith(".json")}
        self.followed: set[tuple] = set()

    def seen(self) -> dict[str, str]:
        return visible(self.command.out)

    def judge(self) -> str:
        """`old`, `new`, or `mixed`, which is recognised."""
        return old_or_new(self.command.out, self.json, self.old, self.new)

    def again(self) -> None:
        shutil.rmtree(self.command.out)
        shutil.copytree(self.command.tmp_path / "before", self.command.out, symlinks=True)

    def follow(self) -> None:
        """The next run succeeds without intervention from every folder state that occurs; equal states are tried
        once."""
        lies = tree(self.command.out)
        if lies in self.followed:
            return
        self.followed.add(lies)
        assert self.command.run("new") == 0
        assert self.seen() == self.new


@pytest.mark.slow
@pytest.mark.parametrize("onwards", [False, True], ids=["one call fails", "all fail from there on"])
def test_a_disk_that_fails_at_the_nth_call(command: Command, onwards: bool, capsys: pytest.CaptureFixture[str]) -> None:
    answers = Answers(command)
    capsys.readouterr()
    refused = 0
    for n in range(1, 2000):
        with disk(command.out, fails(n, onwards=onwards), reads=False) as calls:
            code = command.run("new")
        said = capsys.readouterr()
        assert said.out == ""
        if code == 0:
            assert said.err == ""
            assert answers.seen() == answers.new
        else:
            refused += 1
            assert code == 2
            assert said.err.startswith("avtorch: ")
            assert said.err.count("\n") == 1
            assert ".avtorch" not in said.err
            assert answers.judge() in ("old", "mixed")
            assert answers.seen() == answers.old or "two answers" in said.err
        answers.follow()
        answers.again()
        if len(calls) < n:
            break
    else:
        raise AssertionError("the sweep has no end")
    assert refused > 3


def test_a_reader_at_any_moment_and_a_kill(command: Command) -> None:
    """A killed process leaves what a reader finds at that moment; the next run must succeed from it."""
    answers, seen = Answers(command), list[str]()
    killed = command.tmp_path / "killed"

    def look(n: int, name: str) -> None:
        seen.append(answers.judge())
        shutil.copytree(command.out, killed / str(n), symlinks=True)

    with disk(command.out, look, reads=False) as calls:
        assert command.run("new") == 0
    assert seen == sorted(seen, key=["old", "mixed", "new"].index)
    assert answers.seen() == answers.new
    for n in range(1, len(calls) + 1):
        shutil.rmtree(command.out)
        (killed / str(n)).rename(command.out)
        answers.follow()
