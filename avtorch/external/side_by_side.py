"""Rollouts of a slow simulator side by side: an FMU in more processes of its own, an object in copies of this one."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from multiprocessing.connection import Connection
from typing import Any, Protocol, TypeVar, runtime_checkable

from avtorch.errors import InputError
from avtorch.external.simulator import Simulator

Answer = TypeVar("Answer")
Values = Mapping[str, float]


@runtime_checkable
class Apart(Protocol):
    """A simulator that runs in a process of its own and can be had in another; an `FmuSimulator` is one."""

    def apart(self) -> Simulator: ...

    def close(self) -> None: ...


def side_by_side(
    simulator: Simulator, call: Callable[[Simulator, Values], Answer], each: Sequence[Values], processes: int
) -> list[Answer]:
    """`call(simulator, values)` for each of the values, in order, at most `processes` at once.

    One after another where the system cannot copy a process (Windows). Raises what a call raises.
    """
    count = min(processes, len(each))
    if isinstance(simulator, Apart) and count > 1:
        return _by_threads(simulator, call, each, count)
    if count < 2 or "fork" not in multiprocessing.get_all_start_methods():
        return [call(simulator, values) for values in each]
    return _by_copies(simulator, call, each, count)


def _by_copies(
    simulator: Simulator, call: Callable[[Simulator, Values], Answer], each: Sequence[Values], count: int
) -> list[Answer]:
    # a copy of the process has the simulator, which need not be one that can be sent
    copies = multiprocessing.get_context("fork")
    workers = []
    try:
        for n in range(count):
            here, there = copies.Pipe(duplex=False)
            worker = copies.Process(target=_work, args=(there, simulator, call, each[n::count]), daemon=True)
            worker.start()
            there.close()
            workers.append((worker, here))
        return _in_order([_received(here) for _, here in workers], len(each))
    finally:
        for worker, _ in workers:
            worker.terminate()
            worker.join()


def _work(
    there: Connection, simulator: Simulator, call: Callable[[Simulator, Values], object], share: Sequence[Values]
) -> None:
    try:
        there.send([call(simulator, values) for values in share])
    except InputError as fault:
        there.send(fault)


def _received(here: Connection) -> list[Any]:
    try:
        found = here.recv()
    except EOFError:
        raise InputError("simulator: ended the process that drove it") from None
    if isinstance(found, InputError):
        raise found
    return found


def _by_threads(
    simulator: Apart, call: Callable[[Simulator, Values], Answer], each: Sequence[Values], count: int
) -> list[Answer]:
    others = [simulator.apart() for _ in range(count)]
    try:
        with ThreadPoolExecutor(count) as pool:
            shares = [
                pool.submit(lambda n=n, own=own: [call(own, values) for values in each[n::count]])
                for n, own in enumerate(others)
            ]
            found = [share.result() for share in shares]
    finally:
        for own in others:
            own.close()  # type: ignore[attr-defined]
    return _in_order(found, len(each))


def _in_order(shares: Sequence[Sequence[Answer]], count: int) -> list[Answer]:
    """What was dealt out one by one, put together again."""
    return [shares[k % len(shares)][k // len(shares)] for k in range(count)]
