"""The work of a fleet: one step of one log in one worker, as rows, and all of it worked off by a cluster.

Whatever goes wrong becomes a row that says why.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from avtorch.errors import InputError
from avtorch.fleet.folder import Row, check_rows, diagnosis_rows, failure_rows, window_rows
from avtorch.fleet.log_list import FleetLog, content_hash, fetched, one_line
from avtorch.fleet.settings import FleetSettings, Step
from avtorch.io import Log
from avtorch.io.opening import place
from avtorch.logcheck.check import check

if TYPE_CHECKING:
    from avtorch.gap.result.diagnosis import Diagnosis


@dataclass(frozen=True)
class Task:
    """A `step` for the `log` at `place` with this content; `size` [bytes].

    `report`: makes the page of a diagnosis, where one is wanted; a function that the worker can import.
    """

    step: Step
    log: FleetLog
    place: str
    sha256: str
    size: int
    settings: FleetSettings
    report: Callable[[Diagnosis], str] | None = None

    @property
    def name(self) -> str:
        """That no other task of the run has."""
        return f"{self.step}-{self.log.name}"


@dataclass(frozen=True)
class Outcome:
    """The rows of a task, how long it computed [s], and the page of its diagnosis, where one was wanted."""

    rows: list[Row]
    seconds: float
    report: str | None = None


def work(task: Task) -> Outcome:
    """Do a task. Raises nothing but what ends the process."""
    begun = time.perf_counter()
    page, where = None, task.place
    try:
        with fetched(task.place) as local:
            where = str(local)
            if content_hash(local)[0] != task.sha256:
                raise RuntimeError("the log was changed while the fleet ran; needs another run")
            try:
                rows, page = _rows(task, local)
            except InputError as fault:
                rows = failure_rows("failed", str(fault))
    except InputError as fault:
        rows = failure_rows("crashed", str(fault))  # what could not be reached may be there tomorrow
    except Exception as fault:
        rows = failure_rows("crashed", one_line(fault))
    for row in rows:
        if row.get("error") is not None:  # on a copy from a store, or by a path that the caller did not give
            row["error"] = row["error"].replace(place(where), task.log.shown)
    return Outcome(rows, time.perf_counter() - begun, page)


def _rows(task: Task, local: Path) -> tuple[list[Row], str | None]:
    given = task.settings
    read: dict[str, Any] = {name: getattr(given, name) or None for name in ("map", "unit", "stamp")}
    mapped = any(read.values())
    if task.step == "check":
        return check_rows(check(Log.read(local, **read) if mapped else local)), None
    drive, note = _commanded(Log.read(local, **read))
    return (_estimated(task, drive, note), None) if task.step == "estimate" else _diagnosed(task, drive, note)


def _commanded(drive: Log) -> tuple[Log, str | None]:
    """The drive with an `accel_cmd`, and a note on the map of its pedals where one made it."""
    if drive.accel_cmd is not None or (not drive.pedals and drive.speed_cmd is None):
        return drive, None
    from avtorch.pedals import fit_pedals

    fit = fit_pedals([drive])
    by = " and ".join(fit.map.pedals)
    return fit.map.commanded(drive), f"The log has no accel_cmd: a map of {by} and speed stands for it; K_L is 1 by it."


def _estimated(task: Task, drive: Log, note: str | None) -> list[Row]:
    from avtorch.decision.estimation import estimate
    from avtorch.decision.settings import Setting

    given = task.settings
    found = estimate(
        drive,
        given.window,
        estimator=given.estimator,
        setting=Setting(time_gap=given.time_gap, gains=given.gains, scenarios=1),
        accepted=given.accepted,
        dead_time=given.dead_time,
        seed=given.seed,
        progress=False,  # the fleet's own tells of it
    )
    return window_rows(found, note)


def _diagnosed(task: Task, drive: Log, note: str | None) -> tuple[list[Row], str | None]:
    from avtorch.gap.diagnose import diagnose
    from avtorch.gap.simulator.plant import GapPlant

    given = task.settings
    found = diagnose(
        drive,
        baseline=None if given.baseline == "glvd" else GapPlant.from_toml(given.baseline),
        effects=given.effects,
        pairs=given.pairs,
        posterior=given.posterior,
        budget_s=given.budget_s,
        seed=given.seed,
        progress=False,
    )
    return diagnosis_rows(found, note), None if task.report is None else task.report(found)


def worked_off(client: Any, tasks: Sequence[Task]) -> Iterator[tuple[Task, Outcome]]:
    """What `work` returns for each of the `tasks`, as they are done, begun in the order given.

    A task whose worker ends is done again by another one, as often as the scheduler allows; then its outcome is a row
    that says so, and the log's later steps are not tried. As many tasks run at a time as the cluster has threads, one
    of a log, so that a worker that ends costs its own: Dask suspects every task that a worker had. Raises `InputError`
    where the scheduler is lost, or no worker comes back.
    """
    from distributed import KilledWorker, as_completed
    from distributed.scheduler import NoWorkerError

    waiting = list(tasks)
    running: dict[str, Task] = {}
    futures = as_completed([], with_results=True, raise_errors=False, loop=client.loop)
    while waiting or running:
        while len(running) < max(1, sum(client.nthreads().values())):
            busy = {task.place for task in running.values()}
            task = next((task for task in waiting if task.place not in busy), None)
            if task is None:
                break
            waiting.remove(task)
            running[task.name] = task
            futures.add(client.submit(work, task, key=task.name))
        done, result = next(futures)
        task = running.pop(done.key)
        if done.status == "finished":
            yield task, result
            continue
        if done.status != "error":
            raise InputError("scheduler: the connection was lost; what was done is kept")
        fault = done.exception()
        if isinstance(fault, NoWorkerError):
            raise InputError("memory: no worker lives within it, needs more, such as 2GiB; what was done is kept")
        if not isinstance(fault, KilledWorker):
            yield task, _crashed(one_line(fault))
            continue
        yield task, _crashed("its worker ended each time: killed, or beyond its memory")
        for later in [other for other in waiting if other.place == task.place]:
            waiting.remove(later)
            yield later, _crashed("not tried: its worker ended at an earlier step")


def _crashed(why: str) -> Outcome:
    return Outcome(failure_rows("crashed", why), 0.0)
