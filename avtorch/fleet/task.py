"""The work of a fleet: one step of one log in one worker, as rows, and all of it worked off by a cluster.

Whatever goes wrong becomes a row that says why. As many tasks run at a time as the cluster has threads, so that a
worker that ends costs its own.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from avtorch.errors import InputError, printable
from avtorch.fleet.cluster import ATTEMPTS, Cluster
from avtorch.fleet.folder import Row, Status, check_rows, diagnosis_rows, failure_rows, window_rows
from avtorch.fleet.log_list import content_hash, fetched
from avtorch.fleet.settings import STEPS, FleetSettings, Step
from avtorch.io import Log
from avtorch.io.opening import place
from avtorch.logcheck.check import check
from avtorch.version import __version__

if TYPE_CHECKING:
    from avtorch.gap.result.diagnosis import Diagnosis


NO_WORKER_S = 60.0
"""Without a worker after which a fleet ends [s]: a process starts within ten, also on a busy machine."""
_POLL_S = 0.05


@dataclass(frozen=True)
class Task:
    """A `step` for the log at `place` with this content; `size` [bytes]; a `name` that no other task of the run has.

    `report`: makes the page of a diagnosis, where one is wanted; a function that the worker can import. `shown`: the
    place as the caller has it, for messages; None: as it is.
    """

    name: str
    step: Step
    place: str
    sha256: str
    size: int
    settings: FleetSettings
    report: Callable[[Diagnosis], str] | None = None
    shown: str | None = None
    version: str = __version__


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
        if task.version != __version__:
            raise RuntimeError(f"this worker has avtorch {__version__}, needs {task.version}")
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
        rows = failure_rows("crashed", printable(f"{type(fault).__name__}: {fault}", 400))
    for row in rows:
        if row.get("error") is not None:  # on a copy from a store, or by a path that the caller did not give
            row["error"] = row["error"].replace(place(where), task.shown or task.place)
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


def worked_off(cluster: Cluster, tasks: Sequence[Task]) -> Iterator[tuple[Task, Outcome]]:
    """What `work` returns for each of the `tasks`, as they are done, begun in the order given.

    A task whose worker ends is done again by another one. After `ATTEMPTS` times (or as often as the scheduler of
    another cluster allows) all that is left of its log waits for the end, where nothing else runs beside it: Dask
    suspects every task that a worker had when it ended. If its workers end as often again, its outcome is a row that
    says so, and the log's later steps are not tried. Raises `InputError` where the scheduler is lost, or no worker
    comes back.
    """
    from distributed import as_completed

    waiting, later = deque(tasks), deque[Task]()
    running: dict[str, tuple[Task, Any]] = {}
    suspected: set[str] = set()
    ended: set[str] = set()
    alone = False
    futures = as_completed([], with_results=True, raise_errors=False, loop=cluster.client.loop)
    try:
        while waiting or running or later:
            if not waiting and not running:
                waiting, later, alone = deque(sorted(later, key=_order)), deque(), True
            most = 1 if alone else cluster.threads
            while waiting and len(running) < most:
                task = waiting.popleft()
                if task.place in ended:
                    yield task, _crashed("not tried: its worker ended at an earlier step")
                elif task.place in suspected and not alone:
                    later.append(task)
                else:
                    name = f"{task.name}-alone" if alone else task.name
                    future = cluster.client.submit(work, task, key=name, pure=False)
                    running[future.key] = task, future
                    futures.add(future)
            if not running:
                continue
            done, result = _next(futures, cluster)
            task, future = running.pop(done.key)
            if done.status == "finished":
                yield task, result
            elif done.status != "error":
                raise _without_workers(cluster)
            elif type(fault := future.exception()).__name__ != "KilledWorker":
                yield task, _crashed(printable(f"{type(fault).__name__}: {fault}", 400))
            elif not alone:
                suspected.add(task.place)
                later.append(task)
            else:
                ended.add(task.place)
                times = f"{2 * ATTEMPTS} times" if cluster.local else "again and again"
                yield task, _crashed(f"its worker ended {times}: killed, or beyond its memory ({cluster.limit})")
            future.release()
    finally:
        for _, future in running.values():
            future.release()


def _next(futures: Any, cluster: Cluster) -> tuple[Any, Any]:
    """The next (future, result), waited for as long as a local cluster has workers; another one may begin some."""
    seen = time.monotonic()
    while not futures.has_ready():
        time.sleep(_POLL_S)
        now = time.monotonic()
        if not cluster.local or cluster.client.scheduler_info()["workers"]:
            seen = now
        elif now - seen > NO_WORKER_S:
            raise _without_workers(cluster)
    return next(futures)


def _without_workers(cluster: Cluster) -> InputError:
    """Nobody computes any more: a local cluster's processes need more memory, another one cannot be reached."""
    if not cluster.local:
        return InputError("scheduler: the connection was lost; what was done is kept")
    return InputError(
        f"memory: no worker lives within {cluster.limit}, needs more, such as 2GiB; what was done is kept"
    )


def _order(task: Task) -> int:
    return STEPS.index(task.step)


def _crashed(why: str) -> Outcome:
    return Outcome(failure_rows("crashed", why), 0.0)


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
