"""A simulator along the commands of a car's log, in an open loop: driven by them, or by its output.

It begins anew wherever the car does: at each segment, where the driver lets go, and at each start from standstill.
Between these it drives on its own, at its own speed. At rest a brake holds a car whatever the command says, and a car
and its simulator stop at different moments, so rows in which either stands do not count.

Output may have another clock and another rate: clocks are brought together by the commands, which both have. It is
smooth, so between its rows it is interpolated; the car's readings stay as they are.
"""

from __future__ import annotations

import math
import multiprocessing
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, TypeVar

import numpy as np

from avtorch.arrays import BoolArray, FloatArray
from avtorch.errors import InputError, quoted
from avtorch.external.fmu import FmuSimulator
from avtorch.external.simulator import Simulator, Values, WholeDrives
from avtorch.io import Log


def drives_of(log: Log) -> list[slice]:
    """Rows of `log` that a simulator drives in one go."""
    out = []
    for part in log.engaged_segments():
        starts = [part.start]
        if log.speed is not None:
            stands = log.speed[part] < log.standstill_mps
            starts += [part.start + int(k) for k in np.flatnonzero(np.diff(stands.astype(int)) == -1)]
        edges = [*dict.fromkeys(starts), part.stop]
        out += [slice(a, b) for a, b in pairwise(edges) if b - a > 1]
    return out


def in_drives(simulated: Log, log: Log) -> Log:
    """The simulator's output, in the rows of the car's `log`, with a segment for each of the car's drives.

    Rows in which either stands are not `engaged`.
    """
    edges = np.zeros(log.rows + 1, dtype=np.int64)
    for part in drives_of(log):
        edges[[part.start, part.stop]] = 1
    edges[1:-1] |= np.diff(log.segment) != 0
    segment = np.cumsum(edges[:-1]) - edges[0]
    return replace(simulated, segment=segment, engaged=simulated.engaged & log.moving & simulated.moving)


LIMIT_S = 30.0
"""Longest that a simulator may take for one step or one reset [s]."""
_JUMP_MPS2 = 20.0  # no car accelerates like that
_AVERAGED_S = 0.3  # over which the car's acceleration at the beginning of a drive is averaged


def driven_along(
    simulator: Simulator,
    log: Log,
    *,
    name: str = "simulator",
    step_s: float | None = None,
    progress: Callable[[str, int, int], None] | None = None,
) -> Log:
    """What `simulator` does under the commands of `log`, in its rows; each of its drives is a segment.

    `step_s`: the simulator's own step [s], for one that takes no other; default: from row to row. A row in which the
    car is under the driver keeps the car's readings; one in which either stands is not `engaged`.

    Raises `InputError` for a log without `accel_cmd`, and where the simulator raises, hangs for 30 s, or returns
    what is no pair of finite numbers, with the time in the log.
    """
    if log.accel_cmd is None:
        raise InputError(f"{log.name}: has no accel_cmd, which the simulator would be driven by")
    if step_s is not None and not 0 < step_s < math.inf:
        raise InputError(f"step_s: found {step_s}, needs a step above 0 s")
    accel = np.zeros(log.rows) if log.accel is None else log.accel.copy()
    speed = np.zeros(log.rows) if log.speed is None else log.speed.copy()
    parts = drives_of(log)
    with _limited(LIMIT_S) as again:
        drive = _Drive(simulator, name, step_s, again)
        for number, part in enumerate(parts):
            if progress is not None:
                progress("driving the simulator", number, len(parts))
            accel[part], speed[part] = drive.along(log, part)
    return in_drives(replace(log, name=name, accel=accel, speed=speed), log)


@dataclass
class _Drive:
    """One simulator, with what is said where it fails; `again` begins the time that a call may take."""

    simulator: Simulator
    name: str
    step_s: float | None
    again: Callable[[], None]

    def along(self, log: Log, part: slice) -> tuple[FloatArray, FloatArray]:
        """Acceleration and speed (row,) in the rows of `part`."""
        assert log.accel_cmd is not None
        time, command = log.elapsed[part], log.accel_cmd[part].tolist()
        begin_accel = command[0]
        if log.accel is not None:
            rows = max(1, round(_AVERAGED_S * log.rate_hz))
            begin_accel = float(log.accel[part][:rows].mean())
        begin_speed = 0.0 if log.speed is None else max(float(log.speed[part][0]), 0.0)
        steps = np.diff(time)
        if self.step_s is None and isinstance(self.simulator, WholeDrives):
            later = np.stack(self.simulator.whole_drive(command[:-1], steps, speed=begin_speed, accel=begin_accel), -1)
        else:
            self._called(float(time[0]), lambda: self.simulator.reset(speed=begin_speed, accel=begin_accel), "reset")
            rows = zip(command[:-1], steps.tolist(), time.tolist(), strict=False)
            later = np.array([self._stepped(u, dt, stamp) for u, dt, stamp in rows])
        accel, speed = np.concatenate([[[begin_accel, begin_speed]], later]).T
        if abs(speed[1] - speed[0]) > _JUMP_MPS2 * steps[0]:  # it begins at a speed of its own
            accel[0], speed[0] = accel[1], speed[1] - steps[0] * accel[1]
        return accel, speed

    def _stepped(self, u: float, dt: float, stamp: float) -> tuple[float, float]:
        own = dt if self.step_s is None else self.step_s
        answer: Any = None
        for _ in range(max(1, round(dt / own))):
            answer = self._called(stamp, lambda: self.simulator.step(u, own), "step")
        try:
            accel, speed = map(float, answer)
        except (TypeError, ValueError):
            raise self._fault(stamp, f"step returned {quoted(repr(answer))}, needs (accel, speed)") from None
        if not (math.isfinite(accel) and math.isfinite(speed)):
            told = f"step returned {(accel, speed)}, needs finite numbers; smaller steps may give them"
            raise self._fault(stamp, f"{told} (--step {own / 5:g})")
        return accel, speed

    def _called(self, stamp: float, call: Callable[[], object], what: str) -> object:
        self.again()
        try:
            return call()
        except _TooLongError as late:
            raise self._fault(stamp, f"{what} took more than {late.args[0]:g} s") from None
        except InputError:
            raise
        except Exception as error:
            raise self._fault(stamp, f"{what} raised {type(error).__name__}: {quoted(str(error))}") from error

    def _fault(self, stamp: float, what: str) -> InputError:
        return InputError(f"{self.name}: at {stamp:.6g} s of the log {what}")


class _TooLongError(BaseException):
    """A call that has not returned; no Exception, so that a simulator's own handlers do not take it."""


@contextmanager
def _limited(limit_s: float) -> Iterator[Callable[[], None]]:
    """Calls that end after `limit_s` each, counted from the last call of what this yields. Only where the system has
    such alarms, in the main thread."""
    if not hasattr(signal, "setitimer") or threading.current_thread() is not threading.main_thread():
        yield lambda: None
        return

    def late(_signal: int, _frame: object) -> None:
        raise _TooLongError(limit_s)

    before = signal.signal(signal.SIGALRM, late)
    try:
        yield lambda: signal.setitimer(signal.ITIMER_REAL, limit_s) and None
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)


_FARTHEST_S = 30.0  # that two clocks may be apart beyond what their first rows say
_GRID_S = 0.005
_SAME = 0.05  # of the command's standard deviation, by which two commands may differ (root mean square)


def aligned(simulated: Log, log: Log) -> tuple[Log, float]:
    """The output `simulated` in the rows of the car's `log`, and what its clock was ahead of the car's [s].

    Where both have commands, the clocks are shifted until these agree; where the output has none, both are taken to
    begin at the same moment, unless their clocks overlap. Rows of the car that the output does not cover are marked as
    not `engaged`, so that they do not count.

    Raises `InputError` for other commands than the car's, or an output that covers less than half of the car's rows.
    """
    if simulated.accel is None and simulated.speed is None:
        raise InputError(f"{simulated.name}: has neither accel nor speed, needs one of the two")
    shift = _shift(simulated, log)
    time = log.elapsed + shift
    inside = _covered(simulated, time)
    if inside.mean() < 0.5:
        raise InputError(
            f"{simulated.name}: covers {inside.mean():.0%} of the rows of {log.name}; needs the same drive, of "
            f"{log.elapsed[-1]:.6g} s"
        )
    channels = {
        name: None if values is None else np.interp(time, simulated.elapsed, values)
        for name, values in (("accel", simulated.accel), ("speed", simulated.speed))
    }
    if simulated.accel_cmd is not None and log.accel_cmd is not None:
        _check_commands(simulated, log, time, inside & log.engaged)
    whole = replace(log, name=simulated.name, engaged=log.engaged & inside, **channels)
    return whole, shift + simulated.epoch_s - log.epoch_s


def _shift(simulated: Log, log: Log) -> float:
    """What is added to the car's elapsed time for the simulator's [s]."""
    apart = log.epoch_s - simulated.epoch_s
    overlap = -log.elapsed[-1] < apart < simulated.elapsed[-1]
    begun = apart if overlap else 0.0
    if simulated.accel_cmd is None or log.accel_cmd is None:
        return begun
    from scipy.signal import correlate, correlation_lags

    grid = np.arange(-_FARTHEST_S, log.elapsed[-1] + _FARTHEST_S, _GRID_S)
    one = _held(log.elapsed, log.accel_cmd, grid)
    other = _held(simulated.elapsed - begun, simulated.accel_cmd, grid)
    shared = correlate(other - other.mean(), one - one.mean(), mode="full", method="fft")
    lags = correlation_lags(len(other), len(one))
    near = np.abs(lags) <= _FARTHEST_S / _GRID_S
    best = int(lags[near][np.argmax(shared[near])])
    # commands that agree as they are stay where they are
    still = shared[lags == 0][0]
    return begun if shared[near].max() <= 1.001 * still else begun + best * _GRID_S


def _held(time: FloatArray, values: FloatArray, grid: FloatArray) -> FloatArray:
    """`values` held from row to row, zero outside."""
    row = np.searchsorted(time, grid + 1e-9, side="right") - 1
    return np.where((row >= 0) & (grid <= time[-1]), values[np.maximum(row, 0)], 0.0)


def _covered(simulated: Log, time: FloatArray) -> BoolArray:
    """Rows that lie within a segment of the output."""
    inside = np.zeros(len(time), dtype=bool)
    for part in simulated.segments():
        own = simulated.elapsed[part]
        inside |= (time >= own[0] - 1e-6) & (time <= own[-1] + 1e-6)
    return inside


def _check_commands(simulated: Log, log: Log, time: FloatArray, rows: BoolArray) -> None:
    assert simulated.accel_cmd is not None
    assert log.accel_cmd is not None
    other = _held(simulated.elapsed, simulated.accel_cmd, time)
    # a row's command may change within the other's row: the better of two neighbours
    late = _held(simulated.elapsed, simulated.accel_cmd, time - 1.0 / simulated.rate_hz)
    apart = np.minimum(np.abs(other - log.accel_cmd), np.abs(late - log.accel_cmd))[rows]
    size = float(log.accel_cmd[rows].std())
    if size and float(np.sqrt((apart**2).mean())) > _SAME * size:
        raise InputError(
            f"{simulated.name}: its accel_cmd differs from that of {log.name} by {np.sqrt((apart**2).mean()):.2g} m/s² "
            f"(root mean square, commands have a standard deviation of {size:.2g}); needs the simulator driven by the "
            "car's own commands, in an open loop"
        )


Answer = TypeVar("Answer")
_copied: tuple[Simulator, Callable[[Simulator, Values], Any]] | None = None
"""What a copy of this process drives."""


def side_by_side(
    simulator: Simulator, call: Callable[[Simulator, Values], Answer], each: Sequence[Values], processes: int
) -> list[Answer]:
    """`call(simulator, values)` for each of the values, in order, at most `processes` at once: an FMU in more processes
    of its own, an object in copies of this one, or one after another where the system cannot copy a process (Windows).

    Raises what a call raises.
    """
    count = min(processes, len(each))
    if isinstance(simulator, FmuSimulator) and count > 1:
        others = [simulator.apart() for _ in range(count)]
        shares = [each[n::count] for n in range(count)]
        try:
            with ThreadPoolExecutor(count) as pool:
                found = list(pool.map(lambda own, share: [call(own, values) for values in share], others, shares))
        finally:
            for own in others:
                own.close()
        return [found[k % count][k // count] for k in range(len(each))]
    if count < 2 or "fork" not in multiprocessing.get_all_start_methods():
        return [call(simulator, values) for values in each]
    # a copy of the process has the simulator, which need not be one that can be sent
    copies = multiprocessing.get_context("fork")
    try:
        with ProcessPoolExecutor(count, copies, _take_over, (simulator, call)) as pool:
            return list(pool.map(_called, each))
    except BrokenProcessPool:
        raise InputError("simulator: ended the process that drove it") from None


def _take_over(simulator: Simulator, call: Callable[[Simulator, Values], Any]) -> None:
    global _copied
    _copied = simulator, call


def _called(values: Values) -> Any:
    assert _copied is not None
    simulator, call = _copied
    return call(simulator, values)
