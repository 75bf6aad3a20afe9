"""Drives as rollouts see them: at one rate, their channels, and the stretches that count.

A drive is the part of a segment between two overrides: while a driver is in charge (`engaged` 0) the car does not
follow the command, so no rollout passes through those rows, and after each override a new rollout starts from the
measurement. Of the override rows only the measured speed is used, to integrate the position along the road.

Rows above about 20 Hz are grouped; rollouts have every row. Rows at standstill do not count, but rollouts continue
through them, as if the actuator still followed the command and the ground held the car.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from avtorch.arrays import Float, FloatArray, Int, IntArray
from avtorch.errors import InputError
from avtorch.gap.simulator.simulator_input import SimulatorInput
from avtorch.io import Log
from avtorch.io.clock import ROUNDING_S
from avtorch.io.engagement import SETTLE_S
from avtorch.io.log import no_command

RATE_HZ = 20.0
"""Rows are averaged as long as the resulting rate is at least this [Hz]."""
_SHORTEST_S = 2.0
_FAR_M = 1000.0  # several correlation lengths of the road grade: beyond it roads are independent

FEWEST_BLOCKS = 5
"""On either side of a comparison."""
_BLOCKS = 20  # of a long drive
_WHOLE_S = 10.0  # a block holds one to six of these, so that rollouts of this length fit in
_SHORTER_S = (8.0, 7.0, 6.0, 5.0, 4.0)  # tried in turn where a drive is too short for that


class Cut(NamedTuple):
    """The origin of a drive: `log` and `segment` count from 0 over all logs, `rows` are the log's own."""

    log: int
    segment: int
    rows: slice


@dataclass(frozen=True, eq=False)
class MeasuredRows:
    """Rows as measured, `group` of them averaged into one, and which of these count.

    `time` (row,) [s] from the start of its log, `stamp` (row,) [s] on that log's own clock, `log` (row,) its number;
    `command` (row,) [m/s²]; `accel` [m/s²], `speed` [m/s] (row, group) as measured, None where not in the log.
    `source` (counted,): places of the counted rows; `stretch` (counted,) numbers the stretches without gaps. `dt` [s]
    of an averaged row.
    """

    time: Float[FloatArray, " row"]
    stamp: Float[FloatArray, " row"]
    log: Int[IntArray, " row"]
    command: Float[FloatArray, " row"]
    accel: Float[FloatArray, "row group"] | None
    speed: Float[FloatArray, "row group"] | None
    source: Int[IntArray, " counted"]
    stretch: Int[IntArray, " counted"]
    dt: float
    group: int

    @property
    def rows(self) -> int:
        """Number of counted rows."""
        return len(self.source)

    @property
    def channels(self) -> tuple[str, ...]:
        return tuple(name for name in ("accel", "speed") if getattr(self, name) is not None)

    @property
    def starts(self) -> Int[IntArray, " stretch"]:
        """Index of each stretch's first counted row."""
        return np.flatnonzero(np.diff(self.stretch, prepend=-1))

    @cached_property
    def measured(self) -> Float[FloatArray, "channel counted group"]:
        """Measurements of the channels, (channel, counted, group)."""
        return np.stack([x[self.source] for x in (self.accel, self.speed) if x is not None])


@dataclass(frozen=True, eq=False)
class Record(MeasuredRows):
    """Drives at the log's own rate. `cuts` are their origins; drives of one segment share a road, and `position`
    continues along it."""

    drives: tuple[SimulatorInput, ...]
    cuts: tuple[Cut, ...]

    @classmethod
    def of(cls, logs: Log | Iterable[Log]) -> Record:
        """The record of one or several logs of one car. Raises `InputError` where nothing usable is left."""
        each = [logs] if isinstance(logs, Log) else list(logs)
        same_kind(each)
        drives: list[SimulatorInput] = []
        cuts: list[Cut] = []
        columns: dict[str, list[FloatArray]] = defaultdict(list)
        names = list(dict.fromkeys(log.name for log in each))
        specific = each[0].accel_kind == "specific-force"
        group = grouped(min(log.rate_hz for log in each), RATE_HZ)
        steps = []
        segments = 0
        for number, log in enumerate(each):
            assert log.accel_cmd is not None
            first_segment = segments - int(log.segment[0])
            segments = first_segment + int(log.segment[-1]) + 1
            for cut in rolled(log, group):
                begun = Cut(number, first_segment + int(log.segment[cut.start]), cut)
                position0 = _position(log, drives, cuts, begun)
                cuts.append(begun)
                rows = (cut.stop - cut.start) // group

                def mean(x: FloatArray, cut: slice = cut, rows: int = rows) -> FloatArray:
                    return x[cut].reshape(rows, group).mean(1)

                time = log.elapsed[cut][::group]
                use = log.usable[cut].reshape(rows, group).all(1)
                settled = time - time[0] >= SETTLE_S - ROUNDING_S
                step = float(np.median(np.diff(time)))
                steps.append(step)
                first = max(1, round(0.3 / step))
                accel0 = None if log.accel is None else float(mean(log.accel)[:first].mean())
                own = torch.as_tensor(_even(log.elapsed[cut])), torch.as_tensor(log.accel_cmd[cut])
                quiet = None
                if log.speed is not None:
                    quiet = torch.as_tensor(_quiet(log.speed[cut], float(np.median(np.diff(log.elapsed[cut])))))
                drives.append(SimulatorInput(*own, quiet, accel0, specific, position0))
                of_rows = {"time": time, "stamp": log.time[cut][::group], "log": np.full(rows, number)}
                of_rows |= {"command": mean(log.accel_cmd), "use": (use & settled).astype(float)}
                measured = {"accel": log.accel, "speed": log.speed}
                of_rows |= {name: x[cut].reshape(rows, group) for name, x in measured.items() if x is not None}
                for name, x in of_rows.items():
                    columns[name].append(x)
        returns = sum(int((np.diff(log.engaged.astype(int)) == 1).sum()) for log in each)
        if not drives and all(log.engaged.all() for log in each):
            raise InputError(f"{', '.join(names)}: no drive of two seconds or more, nothing to diagnose")
        dt = float(np.median(steps)) if drives else np.inf
        source, stretch = _places(columns["use"], dt)
        if not drives or len(source) < 10 / dt:
            seconds = len(source) * dt if drives else 0.0
            each_return = f" and each of {returns} return{'s' * (returns != 1)} to engaged" if returns else ""
            raise InputError(
                f"{', '.join(names)}: {seconds:.1f} s of usable driving (moving, engaged, "
                f"2 s into each drive{each_return}), needs 10 s or more"
            )

        whole = {name: np.concatenate(each) for name, each in columns.items()}
        return cls(
            drives=tuple(drives),
            cuts=tuple(cuts),
            time=whole["time"],
            stamp=whole["stamp"],
            log=whole["log"].astype(np.int64),
            accel=whole.get("accel"),
            speed=whole.get("speed"),
            command=whole["command"],
            dt=dt,
            source=source,
            stretch=stretch,
            group=group,
        )

    def at_counted_rows(self, responses: Sequence[Tensor]) -> Float[FloatArray, "*column counted group"]:
        """Responses by drive, (..., time) each, at counted rows: (..., counted, group)."""
        whole = torch.cat([x.unflatten(-1, (-1, self.group)) for x in responses], -2)
        return whole.numpy()[..., self.source, :]


def same_kind(logs: Sequence[Log]) -> None:
    """Raises `InputError` for logs without `accel_cmd`, or with different channels, rates or kinds of `accel`."""
    if not logs:
        raise InputError("logs: none given, needs one or more")
    names = ", ".join(dict.fromkeys(log.name for log in logs))
    for log in logs:
        if log.accel_cmd is None:
            raise no_command(log, ", which the diagnosis needs")
    if len({(log.accel is not None, log.speed is not None) for log in logs}) > 1:
        raise InputError(f"logs: {names} have different channels; needs accel, speed or both in all")
    if len({log.accel_kind for log in logs}) > 1:
        raise InputError(f"logs: {names} have different kinds of accel; needs one in all")
    rates = [log.rate_hz for log in logs]
    if max(rates) > 1.02 * min(rates):
        given = ", ".join(f"{log.name} {log.rate_hz:.3g} Hz" for log in logs)
        raise InputError(f"logs: found rates of {given}; needs one rate in all, or one diagnosis each")


def grouped(rate: float, least: float) -> int:
    """Number of rows to average into one, at `rate` [Hz], so that about `least` [Hz] are left.

    Clocks deviate slightly, so the bound lies 2 % below the usual rates of recorders, not on one of them.
    """
    return max(1, int(1.02 * rate / least))


def rolled(log: Log, group: int) -> Iterator[slice]:
    """The rows of `log` that form a drive each: drives of 40 groups or more, in whole groups."""
    for part in log.engaged_segments():
        rows = (part.stop - part.start) // group
        if rows >= 2 * RATE_HZ:
            yield slice(part.start, part.start + rows * group)


def _position(log: Log, drives: Sequence[SimulatorInput], cuts: Sequence[Cut], begun: Cut) -> float:
    """Position on its segment's road [m] at which a drive begins; the car also moves during overrides."""
    if log.speed is None or not cuts or cuts[-1].segment != begun.segment:
        return 0.0
    position = drives[-1].position
    assert position is not None
    between = slice(cuts[-1].rows.stop - 1, begun.rows.start + 1)
    moved = np.trapezoid(np.maximum(log.speed[between], 0.0), log.elapsed[between])
    return float(position[-1]) + min(float(moved), _FAR_M)


def _even(time: FloatArray) -> FloatArray:
    """Time stamps, made uniform where they only jitter in their last digits."""
    even = np.linspace(time[0], time[-1], len(time))
    return even if np.abs(even - time).max() < 0.02 * (even[1] - even[0]) else time


def _quiet(speed: FloatArray, dt: float) -> FloatArray:
    """The measured speed with most of its noise filtered out, for what depends on speed."""
    from scipy.ndimage import gaussian_filter1d

    return np.asarray(np.maximum(gaussian_filter1d(speed, 0.15 / dt, mode="nearest"), 0.0))


def _places(use: list[FloatArray], dt: float) -> tuple[IntArray, IntArray]:
    """The rows in use (counted,), of stretches that are long enough, and the number of each one's stretch."""
    source, stretch, offset = [], [], 0
    for rows in use:
        edges = np.flatnonzero(np.diff(np.concatenate([[0], rows.astype(int), [0]])))
        for begin, end in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
            if (end - begin) * dt >= _SHORTEST_S:
                stretch.append(np.full(end - begin, len(source)))
                source.append(offset + np.arange(begin, end))
        offset += len(rows)
    empty = np.zeros(0, np.int64)
    return (np.concatenate(source), np.concatenate(stretch)) if source else (empty, empty)


def blocks_of(record: Record, *, fewest: int = 0) -> list[slice]:
    """A partition of the counted rows into blocks of 10 to 60 s; short stretches are blocks of their own.

    Where these are not `fewest`, blocks as short as 4 s.
    """
    blocks: list[slice] = []
    for whole_s in (_WHOLE_S, *_SHORTER_S):
        blocks = list(_blocks(record, whole_s))
        if len(blocks) >= fewest:
            break
    return blocks


def _blocks(record: Record, whole_s: float) -> Iterator[slice]:
    seconds = whole_s * float(np.clip(round(record.rows * record.dt / _BLOCKS / whole_s), 1, 6))
    for begin, end in pairwise([*record.starts.tolist(), record.rows]):
        count = max(1, int((end - begin) * record.dt / seconds + 1e-9))
        edges = np.linspace(begin, end, count + 1).round().astype(int).tolist()
        yield from (slice(a, b) for a, b in pairwise(edges))
