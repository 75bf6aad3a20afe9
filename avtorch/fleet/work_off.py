"""Tasks worked off by a cluster: as many at a time as it has threads, so that a worker that ends costs its own."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from typing import Any

from avtorch.errors import InputError, printable
from avtorch.fleet.cluster import ATTEMPTS, Cluster
from avtorch.fleet.rows import failure_rows
from avtorch.fleet.settings import STEPS
from avtorch.fleet.task import Outcome, Task, work


def worked_off(cluster: Cluster, tasks: Sequence[Task]) -> Iterator[tuple[Task, Outcome]]:
    """What `work` returns for each of the `tasks`, as they are done, begun in the order given.

    A task whose worker ends is done again by another one. After `ATTEMPTS` times (or as often as the scheduler of
    another cluster allows) all that is left of its log waits for the end, where nothing else runs beside it: Dask
    suspects every task that a worker had when it ended. If its workers end as often again, its outcome is a row that
    says so, and the log's later steps are not tried. Raises `InputError` where the scheduler is lost.
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
            done, result = next(futures)
            task, future = running.pop(done.key)
            if done.status == "finished":
                yield task, result
            elif done.status != "error":
                raise InputError("scheduler: the connection was lost; what was done is kept")
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


def _order(task: Task) -> int:
    return STEPS.index(task.step)


def _crashed(why: str) -> Outcome:
    return Outcome(failure_rows("crashed", why), 0.0)
