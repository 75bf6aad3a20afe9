"""Drives as rollouts see them: at one rate, their channels, and the stretches that count.

A drive is the part of a segment between two overrides: while a driver is in charge (`engaged` 0) the car does not
follow the command, so no rollout passes through those rows, and after each override a new rollout starts from the
measurement. Of the override rows only the measured speed is used, to integrate the position along the road.

Rows above about 20 Hz are grouped; rollouts have every row. Rows at standstill do not count, but rollouts continue
through them, as if the actuator still followed the command and the ground held the car.

A simulated speed is compared in free runs, each begun at what was measured: over a whole drive the speed of any model
drifts away. An acceleration needs no beginning, as the lag forgets it.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import torch
from scipy.ndimage import gaussian_filter1d
from torch import Tensor

from avtorch.arrays import Float, FloatArray, Int, IntArray
from avtorch.errors import InputError
from avtorch.gap.simulator.plant import GapPlant
from avtorch.gap.simulator.simulator_input import SimulatorInput
from avtorch.io import Log
from avtorch.io.clock import ROUNDING_S
from avtorch.io.engagement import SETTLE_S
from avtorch.io.log import no_command

HORIZON_S = 10.0
"""Of the free runs by whose errors simulators are judged [s]."""
BEGIN_S = 0.5
"""Over which the measured speed at the begin of a free run is averaged [s]."""
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
    """The origin of a drive: its `rows` in log number `log`."""

    log: int
    rows: slice


@dataclass(frozen=True, eq=False)
class MeasuredRows:
    """The rows that count, each the mean of `group` rows of a log.

    `time` (counted,) [s] from the start of log number `log` (counted,); `command` (counted,) [m/s²]; `measured`: rows
    of the `channels` as they are in the log, `accel` [m/s²] before `speed` [m/s]. `stretch` (counted,) numbers the
    stretches without gaps. `dt` [s] of an averaged row.
    """

    time: Float[FloatArray, " counted"]
    log: Int[IntArray, " counted"]
    command: Float[FloatArray, " counted"]
    channels: tuple[str, ...]
    measured: Float[FloatArray, "channel counted group"]
    stretch: Int[IntArray, " counted"]
    dt: float
    group: int

    @property
    def rows(self) -> int:
        """Number of counted rows."""
        return len(self.time)

    @property
    def starts(self) -> Int[IntArray, " stretch"]:
        """Index of each stretch's first counted row."""
        return np.flatnonzero(np.diff(self.stretch, prepend=-1))

    @property
    def stretches(self) -> list[slice]:
        """Counted rows of each stretch."""
        return [slice(a, b) for a, b in pairwise([*self.starts.tolist(), self.rows])]

    @property
    def longest_s(self) -> float:
        """Length of the longest free runs [s]: `HORIZON_S`, or that of the longest stretch."""
        return min(HORIZON_S, max(part.stop - part.start for part in self.stretches) * self.dt)

    def squares(self, errors: FloatArray, parts: Sequence[slice], horizon: float = HORIZON_S) -> dict[str, FloatArray]:
        """Sums of squared errors (part,), by metric, of a rollout's `errors` (channel, counted, group) in free runs of
        at most `horizon` [s] over each of `parts` of counted rows."""
        group, out = self.group, {}
        own = [slice(part.start * group, part.stop * group) for part in parts]
        for name, x in zip(self.channels, errors.reshape(len(self.channels), -1), strict=True):
            runs = runs_over(own, round(horizon / self.dt) * group)
            away = free_runs(x, runs, self.dt / group) if name == "speed" else x
            out[f"rollout_rmse_{name}"] = np.array([away[part] @ away[part] for part in own])
        return out

    def rms(self, errors: FloatArray) -> dict[str, float]:
        """Root mean squares by channel of a rollout's `errors` (channel, counted, group) in free runs over all rows."""
        squares = self.squares(errors, self.stretches).values()
        rows = self.rows * self.group
        return {name: float(np.sqrt(x.sum() / rows)) for name, x in zip(self.channels, squares, strict=True)}


@dataclass(frozen=True, eq=False)
class Record(MeasuredRows):
    """Drives at the log's own rate. `cuts` are their origins; drives of one segment share a road, and `position`
    continues along it. `source` (counted,): places of the counted rows among the averaged rows of all drives."""

    drives: tuple[SimulatorInput, ...]
    cuts: tuple[Cut, ...]
    source: Int[IntArray, " counted"]

    @classmethod
    def of(cls, logs: Log | Iterable[Log]) -> Record:
        """The record of one or several logs of one car. Raises `InputError` where nothing usable is left."""
        each = [logs] if isinstance(logs, Log) else list(logs)
        same_kind(each)
        group = grouped(min(log.rate_hz for log in each), RATE_HZ)
        channels = tuple(name for name in ("accel", "speed") if getattr(each[0], name) is not None)
        cuts = [Cut(number, rows) for number, log in enumerate(each) for rows in rolled(log, group)]
        drives: list[SimulatorInput] = []
        columns: dict[str, list[FloatArray]] = defaultdict(list)
        for k, (number, rows) in enumerate(cuts):
            log = each[number]
            assert log.accel_cmd is not None
            before = cuts[k - 1].rows if k and cuts[k - 1].log == number else None
            drives.append(_drive(log, rows, group, _position(log, drives, before, rows)))
            time = log.elapsed[rows][::group]
            columns["time"].append(time)
            columns["log"].append(np.full(len(time), number))
            columns["command"].append(log.accel_cmd[rows].reshape(-1, group).mean(1))
            columns["measured"].append(np.stack([getattr(log, x)[rows].reshape(-1, group) for x in channels]))
            settled = time - time[0] >= SETTLE_S - ROUNDING_S
            columns["use"].append(log.usable[rows].reshape(-1, group).all(1) & settled)
        dt = float(np.median([np.median(np.diff(time)) for time in columns["time"]])) if cuts else 1.0
        source, stretch = _places(columns["use"], dt)
        if len(source) < 10 / dt:
            returns = sum(int((np.diff(log.engaged.astype(int)) == 1).sum()) for log in each)
            each_return = f" and each of {returns} return{'s' * (returns != 1)} to engaged" if returns else ""
            raise InputError(
                f"{', '.join(dict.fromkeys(log.name for log in each))}: {len(source) * dt:.1f} s of usable driving "
                f"(moving, engaged, 2 s into each drive{each_return}), needs 10 s or more"
            )
        return cls(
            drives=tuple(drives),
            cuts=tuple(cuts),
            time=np.concatenate(columns["time"])[source],
            log=np.concatenate(columns["log"])[source].astype(np.int64),
            command=np.concatenate(columns["command"])[source],
            channels=channels,
            measured=np.concatenate(columns["measured"], 1)[:, source],
            dt=dt,
            source=source,
            stretch=stretch,
            group=group,
        )

    def at_counted_rows(self, responses: Sequence[Tensor]) -> Float[FloatArray, "*column counted group"]:
        """Responses by drive, (..., time) each, at counted rows: (..., counted, group)."""
        whole = torch.cat([x.unflatten(-1, (-1, self.group)) for x in responses], -2)
        return whole.numpy()[..., self.source, :]

    def rolled_out(self, simulator: GapPlant) -> Float[FloatArray, "channel counted group"]:
        """What a simulator makes of the whole drives."""
        responses = [simulator.response(drive) for drive in self.drives]
        channels = {"accel": [r.accel_measured for r in responses], "speed": [r.speed_measured for r in responses]}
        return np.stack([self.at_counted_rows(channels[name]) for name in self.channels])


def runs_over(parts: Iterable[slice], rows: int) -> list[slice]:
    """Each part cut into runs of `rows` rows, the last one of what is left."""
    return [slice(i, min(i + rows, part.stop)) for part in parts for i in range(part.start, part.stop, rows)]


def free_runs(errors: FloatArray, runs: Iterable[slice], dt: float) -> FloatArray:
    """Errors (..., row) of a speed, rows `dt` [s] apart, in runs that begin at the mean measured over `BEGIN_S`."""
    out, begin = errors.copy(), max(1, round(BEGIN_S / dt))
    for run in runs:
        out[..., run] -= errors[..., run][..., :begin].mean(-1, keepdims=True)
    return out


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


def _drive(log: Log, rows: slice, group: int, position: float) -> SimulatorInput:
    """The rows of a log that begin at this position [m] of their road."""
    assert log.accel_cmd is not None
    time = log.elapsed[rows]
    quiet = accel0 = None
    if log.speed is not None:
        quiet = torch.as_tensor(_quiet(log.speed[rows], float(np.median(np.diff(time)))))
    if log.accel is not None:
        first = group * max(1, round(0.3 / float(np.median(np.diff(time[::group])))))
        accel0 = float(log.accel[rows][:first].mean())
    own = torch.as_tensor(_even(time)), torch.as_tensor(log.accel_cmd[rows])
    return SimulatorInput(*own, quiet, accel0, log.accel_kind == "specific-force", position)


def _position(log: Log, drives: Sequence[SimulatorInput], before: slice | None, rows: slice) -> float:
    """Position on its segment's road [m] at which a drive begins; the car also moves during overrides."""
    if log.speed is None or before is None or log.segment[before.start] != log.segment[rows.start]:
        return 0.0
    position = drives[-1].position
    assert position is not None
    between = slice(before.stop - 1, rows.start + 1)
    moved = np.trapezoid(np.maximum(log.speed[between], 0.0), log.elapsed[between])
    return float(position[-1]) + min(float(moved), _FAR_M)


def _even(time: FloatArray) -> FloatArray:
    """Time stamps, made uniform where they only jitter in their last digits."""
    even = np.linspace(time[0], time[-1], len(time))
    return even if np.abs(even - time).max() < 0.02 * (even[1] - even[0]) else time


def _quiet(speed: FloatArray, dt: float) -> FloatArray:
    """The measured speed with most of its noise filtered out, for what depends on speed."""
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
    for part in record.stretches:
        count = max(1, int((part.stop - part.start) * record.dt / seconds + 1e-9))
        edges = np.linspace(part.start, part.stop, count + 1).round().astype(int).tolist()
        yield from (slice(a, b) for a, b in pairwise(edges))
