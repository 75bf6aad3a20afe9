"""Tasks of a trial worked off by one process or several, each with one thread."""

from __future__ import annotations

import multiprocessing
import os
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing import parent_process
from typing import Any, TypeVar

from avtorch.errors import InputError

T = TypeVar("T")


def worked(work: Callable[[T], int], tasks: Sequence[T], workers: int) -> Iterator[int]:
    """What `work` returns for each of the `tasks`, as they are done; both can be pickled where `workers` is above 1."""
    if workers == 1 or len(tasks) < 2:
        yield from map(work, tasks)
        return
    # spawned, since a fork of a process whose torch has threads may hang
    context = multiprocessing.get_context("spawn")
    with _one_thread(), ProcessPoolExecutor(workers, mp_context=context, initializer=_begin_worker) as pool:
        waiting = [pool.submit(work, task) for task in tasks]
        try:
            for one in as_completed(waiting):
                yield one.result()
        except BrokenProcessPool:
            raise InputError(
                "workers: one was ended from outside, perhaps for lack of memory; what was answered is kept, "
                "needs fewer workers"
            ) from None
        finally:
            pool.shutdown(wait=False, cancel_futures=True)


@contextmanager
def _one_thread() -> Iterator[None]:
    """Children begun within use one thread each; this must be set before their libraries are loaded."""
    names = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")
    before = {name: os.environ.get(name) for name in names}
    os.environ.update(dict.fromkeys(names, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


def _begin_worker() -> None:
    """Settings of a worker process: one thread each, and no life without the process that started it."""
    import torch

    torch.set_num_threads(1)
    parent = parent_process()
    if parent is not None:
        threading.Thread(target=_end_with, args=(parent,), daemon=True).start()


def _end_with(parent: Any) -> None:
    parent.join()
    os._exit(1)
