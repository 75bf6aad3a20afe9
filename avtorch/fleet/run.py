"""A fleet: every log checked, estimated and diagnosed by a cluster, what is missing only."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Any

from avtorch.display.progress import called, shows_progress
from avtorch.errors import InputError, quoted
from avtorch.fleet.cluster import Cluster, connected, require_dask
from avtorch.fleet.folder import FleetFolder, failure_rows, task_key
from avtorch.fleet.log_list import FleetLog, LogList, content_hash, fetched, find_logs, is_url
from avtorch.fleet.ranking import fleet_answer
from avtorch.fleet.settings import STEPS, FleetSettings, Step
from avtorch.fleet.task import Task, worked_off
from avtorch.io import sole_use, write_json

if TYPE_CHECKING:
    from avtorch.gap.result.diagnosis import Diagnosis

FLEET = "fleet.json"
READERS = 4
"""Logs read at a time to find out whether they have changed."""

_COST: dict[Step, int] = {"check": 1, "estimate": 25, "diagnose": 100}
"""How long a step of a log takes beside the others, roughly."""


@shows_progress
def run_fleet(
    logs: str | os.PathLike[str] | Iterable[str | os.PathLike[str]] | LogList,
    out: str | os.PathLike[str],
    *,
    settings: FleetSettings | None = None,
    workers: int | None = None,
    memory: str = "2GiB",
    scheduler: str | None = None,
    retry: bool = False,
    report: Callable[[Diagnosis], str] | None = None,
    progress: Callable[[str, int, int], None] | bool | None = None,
    connected_to: Callable[[Cluster], None] | None = None,
) -> dict[str, Any]:
    """Check, estimate and diagnose each log of a fleet on a Dask cluster; write and return `out/fleet.json`.

    Rows go to the Parquet datasets `checks`, `windows` and `diagnoses` in `out` as they come (`read_rows`). A later
    call with the same `out` computes what is missing: new logs, logs whose content has changed, other settings, another
    version of avtorch, and what had crashed. A log that cannot be used has a row that says why.

    Args:
        logs: what `find_logs` takes, or what it returns.
        settings: what is done, with which options; default: all, as the commands do by default.
        workers: processes of a cluster on this machine, one thread each (default: one a core); a script that begins
            work needs `if __name__ == "__main__"`.
        memory: at most for each of them; one that needs more is ended, and its log is tried again.
        scheduler: the address of an existing cluster, which has avtorch installed and reads the logs at the same
            places; `workers` and `memory` are then its own.
        retry: try logs again that failed in an earlier call.
        report: makes the page of a diagnosis, such as `avtorch.report.report_html`; it is written beside the rows, and
            a diagnosis of an earlier call that has none is computed again. Workers need to be able to import it.
        progress: called with (sentence, done, of), in units of work; or True, False, None, as in `avtorch.diagnose`.
        connected_to: called with the cluster once there is one.

    Raises `InputError` for logs, settings or a cluster that cannot be used, where Dask is not installed, and for a
    folder that cannot be written or that another process uses.

    Example:
        >>> from avtorch import GLVDPlant, Leader, simulate
        >>> from avtorch.fleet import FleetSettings, run_fleet
        >>> simulate(Leader.default(start=30.0, duration=20.0, dt=0.05), plant=GLVDPlant(0.4, 0.9)).log().write("a.csv")
        >>> quick = FleetSettings(steps=("check", "estimate"), estimator="map")
        >>> answer = run_fleet("a.csv", "out", settings=quick, workers=1)
        >>> car = answer["cars"][0]
        >>> car["car"], car["reason"], round(car["T_L"]["mean"], 1)
        ('a', 'sound', 0.4)
        >>> run_fleet("a.csv", "out", settings=quick)["work"]["computed"]  # nothing is missing
        0
    """
    steps = called(progress)
    given = FleetSettings() if settings is None else settings
    if scheduler is None and workers is not None and workers < 1:
        raise InputError(f"workers: found {workers}, needs 1 or more")
    require_dask()
    given.refuse_unknown()
    if is_url(os.fspath(out)):
        raise InputError(f"out: found {quoted(os.fspath(out))}; output is local: needs a folder of this machine")
    found = logs if isinstance(logs, LogList) else find_logs(logs, leave_out=out)
    folder = FleetFolder(Path(out))
    with sole_use(out, work="a fleet"):
        tasks, kept, notes = _plan(found.logs, folder, given, retry=retry, report=report, progress=steps)
        if tasks:
            from dask.system import CPU_COUNT

            with connected(min(workers or CPU_COUNT, len(tasks)), memory, scheduler) as cluster:
                if connected_to is not None:
                    connected_to(cluster)
                cost, of, failed = 0, sum(_COST[task.step] for task in tasks), 0
                for number, (task, outcome) in enumerate(worked_off(cluster.client, tasks), 1):
                    key = task_key(task.step, task.sha256, given)
                    about = {"sha256": task.sha256, "seconds": outcome.seconds, "report": outcome.report}
                    failed += folder.write(task.step, task.log, key, outcome.rows, **about) != "done"
                    cost += _COST[task.step]
                    if steps is not None:
                        also = f", {kept} kept" if kept else ""
                        words = f"{number} of {len(tasks)} answers, {failed} failed{also}"
                        steps(words, cost, of)
        answer = fleet_answer(found, folder, given)
        answer["notes"] += notes
        answer["work"] = {"kept": kept, "computed": len(tasks)}
        write_json(Path(out) / FLEET, answer)
    return answer


def _plan(
    logs: Sequence[FleetLog],
    folder: FleetFolder,
    settings: FleetSettings,
    *,
    retry: bool,
    report: Callable[[Diagnosis], str] | None,
    progress: Callable[[str, int, int], None] | None,
) -> tuple[list[Task], int, list[str]]:
    """The tasks that are missing; the number of answers that are there; and a sentence on each log that cannot be read
    now, but could in an earlier call."""
    tasks: list[Task] = []
    unread: dict[str, str] = {}
    kept = 0
    with ThreadPoolExecutor(READERS) as pool:
        for number, (log, content) in enumerate(zip(logs, pool.map(_content, logs), strict=True), 1):
            if progress is not None:
                progress("reading", number, len(logs))
            for step in settings.steps:
                if isinstance(content, str):
                    if folder.has_answer(step, log):
                        unread[log.place] = f"Not read this time, its earlier rows are kept: {content}"
                        kept += 1
                    else:  # a file that is not there may come
                        rows = failure_rows("crashed", content)
                        folder.write(step, log, task_key(step, None, settings), rows, sha256=None, seconds=0.0)
                    continue
                sha256, size = content
                status = folder.kept(step, log, task_key(step, sha256, settings))
                if status == "done" and step == "diagnose" and report is not None and not folder.report(log).is_file():
                    status = None
                if status == "done" or (status == "failed" and not retry):
                    kept += 1
                else:
                    tasks.append(Task(step, log, log.identity, sha256, size, settings, report))
    # what is soon done first, and the longest diagnoses before the short ones, which then fill the last gaps
    tasks.sort(key=lambda task: (STEPS.index(task.step), -task.size))
    return tasks, kept, list(unread.values())


def _content(log: FleetLog) -> tuple[str, int] | str:
    """The hash of a log and its bytes, or why it cannot be read."""
    try:
        with fetched(log.place) as local:
            return content_hash(local)
    except (InputError, OSError) as fault:
        return str(fault)
