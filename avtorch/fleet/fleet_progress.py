"""How far a fleet is: answers done and failed, and the work that is left, by how long each step has taken so far."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from avtorch.fleet.rows import Status
from avtorch.fleet.settings import STEPS, Step
from avtorch.fleet.task import Task

FIRST_S: dict[Step, float] = {"check": 0.2, "estimate": 5.0, "diagnose": 20.0}
"""What a step of a log takes [s], until one was done: of a minute's log on one core."""


class FleetProgress:
    """Calls `progress` with (sentence, done, of) in milliseconds of work; `kept`: answers that were there before."""

    def __init__(self, progress: Callable[[str, int, int], None] | None, tasks: Sequence[Task], kept: int) -> None:
        self._progress, self._kept = progress, kept
        self._of: dict[Step, int] = {step: sum(task.step == step for task in tasks) for step in STEPS}
        self._done: dict[Step, int] = dict.fromkeys(STEPS, 0)
        self._seconds: dict[Step, float] = dict.fromkeys(STEPS, 0.0)
        self._failed = 0

    def done(self, step: Step, status: Status, seconds: float) -> None:
        """A task was done."""
        self._done[step] += 1
        self._seconds[step] += seconds
        self._failed += status != "done"
        if self._progress is None:
            return
        all_ = sum(self._of.values())
        words = f"{sum(self._done.values())} of {all_} answers, {self._failed} failed"
        words += f", {self._kept} kept" if self._kept else ""
        cost = {step: self._seconds[step] / n if n else FIRST_S[step] for step, n in self._done.items()}
        done, of = (sum(1000 * cost[step] * n for step, n in counts.items()) for counts in (self._done, self._of))
        self._progress(words, round(done), round(of))
