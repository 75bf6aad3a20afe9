"""Dask: a local cluster of worker processes, or the scheduler of an existing one."""

from __future__ import annotations

import importlib.util
import logging
import math
import signal
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from avtorch.errors import InputError, quoted
from avtorch.fleet.log_list import one_line

CONNECT_S = 20.0
"""Time for a scheduler to answer, and for it to have a worker [s]."""

_LOCAL = {
    "distributed.scheduler.allowed-failures": 2,
    # a process starts within ten seconds, also on a busy machine
    "distributed.scheduler.no-workers-timeout": "60s",
    # a row is small: nothing is worth spilling, and a paused worker would never go on
    "distributed.worker.memory.target": False,
    "distributed.worker.memory.spill": False,
    "distributed.worker.memory.pause": False,
    "distributed.worker.memory.terminate": 0.95,
    # on one machine a worker that does not answer is busy; one that ended is known by its process
    "distributed.scheduler.worker-ttl": None,
    "distributed.admin.tick.limit": "1h",
    # these would take the interpreter from the work 50 and 100 times a second
    "distributed.admin.tick.interval": "1s",
    "distributed.worker.profile.enabled": False,
}


@dataclass(frozen=True)
class Cluster:
    """A connected `client`, and the address of its `dashboard`."""

    client: Any
    dashboard: str | None


def require_dask() -> None:
    """Raises `InputError` saying what to install where Dask is not there; loads nothing."""
    for name in ("dask", "distributed"):
        if importlib.util.find_spec(name) is None:
            raise InputError(f"a fleet needs {name}, which is not installed: pip install 'avtorch[fleet]'")


def memory_bytes(text: str) -> int:
    """`2GiB` as a number. Raises `InputError` where it is none."""
    from dask.utils import parse_bytes

    try:
        size = parse_bytes(text)
    except ValueError:
        size = 0
    if not math.isfinite(size) or size < 2**20:
        raise InputError(f"memory: found {quoted(text)}, needs a size such as 2GiB or 800MB")
    return int(size)


@contextmanager
def connected(workers: int, memory: str, scheduler: str | None) -> Iterator[Cluster]:
    """A cluster of `workers` processes with one thread and at most `memory` each, or the one behind `scheduler`.

    Raises `InputError` for a size that is none, and for a scheduler that cannot be reached, has no worker, or has
    workers without this version of avtorch.
    """
    require_dask()
    with _quiet(), _local(workers, memory) if scheduler is None else _existing(scheduler) as found:
        yield found


@contextmanager
def _local(workers: int, memory: str) -> Iterator[Cluster]:
    from dask import config
    from distributed import Client, LocalCluster

    shown = importlib.util.find_spec("bokeh") is not None
    with config.set(_LOCAL):
        cluster = LocalCluster(
            n_workers=workers,
            threads_per_worker=1,
            processes=True,
            memory_limit=memory_bytes(memory),
            host="127.0.0.1",
            dashboard_address="127.0.0.1:0",
            silence_logs=logging.CRITICAL,
            preload=["avtorch.fleet.cluster"],
        )
        with cluster, Client(cluster) as client:
            yield Cluster(client, cluster.dashboard_link if shown else None)


@contextmanager
def _existing(scheduler: str) -> Iterator[Cluster]:
    from distributed import Client

    from avtorch.version import __version__

    needs = "needs the address of a running scheduler, such as tcp://10.0.0.1:8786"
    try:
        client = Client(scheduler, timeout=CONNECT_S, set_as_default=False)
    except (OSError, ValueError, TimeoutError) as fault:
        raise InputError(f"scheduler: {quoted(scheduler)} cannot be reached ({one_line(fault)}); {needs}") from None
    with client:
        try:
            client.wait_for_workers(1, timeout=CONNECT_S)
        except TimeoutError:
            raise InputError(
                f"scheduler: {quoted(scheduler)} has no worker after {CONNECT_S:.0f} s; needs dask worker {scheduler}"
            ) from None
        versions: Any = client.run(_version, on_error="return")
        for worker, version in versions.items():
            if isinstance(version, BaseException):
                raise InputError(f"scheduler: worker {worker} has no avtorch ({one_line(version)})")
            if version != __version__:
                raise InputError(f"scheduler: worker {worker} has avtorch {version}, needs avtorch {__version__}")
        try:
            link = client.dashboard_link
        except Exception:  # a scheduler without a server for it
            link = None
        yield Cluster(client, link or None)


def _version() -> str:
    from avtorch.version import __version__

    return __version__


@contextmanager
def _quiet() -> Iterator[None]:
    """Dask neither warns nor logs meanwhile: what matters of it becomes a row or an error."""
    logger = logging.getLogger("distributed")
    before = logger.level
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        logger.setLevel(logging.CRITICAL + 1)
        try:
            yield
        finally:
            logger.setLevel(before)


def dask_setup(worker: Any) -> None:
    """Leave Ctrl-C to the process that began the work, and it ends its workers."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
