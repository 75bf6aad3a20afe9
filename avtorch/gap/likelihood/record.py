"""What a diagnosis looks at: drives at one rate, their witnesses, and the stretches that count.

Rows above some 20 Hz come in groups. A search may begin with `coarse` rollouts, of which only the groups' means are
compared; what a candidate is worth is told at every row, since a controller feeds the noise of a row back into the
command of the next, and means alone would take that for a lag. Rows at standstill or with a driver's foot in
(`engaged` 0) do not count.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from avtorch.errors import InputError
from avtorch.gap.chain.drive import Drive, Place
from avtorch.io import Log
from avtorch.io.log import AccelKind

Float = NDArray[np.float64]

RATE_HZ = 20.0
"""Rows are averaged as long as at least this many a second are left [Hz]."""
_SETTLE_S = 2.0  # at a drive's start the actuator's state is not known; a few lags
_SHORTEST_S = 2.0
_FEW = 20_000  # rows of a log short enough to be rolled out in full wherever means would do
_GAP_S = 5.0  # zeros between stretches, over which a filter forgets


@dataclass(frozen=True, eq=False)
class Record:
    """Drives at the log's own rate, and where in one long array of rows averaged to `dt` [s] those stand that count.

    `accel`, `speed` (row, group): measured, over all drives' rows one after another; None: not in the log. `time`
    (row,) [s], the log's own; `command` (row,), mean of a group. `source`, `target`: of every counted row its index in
    these arrays and in the padded one of `length` rows that is filtered; `stretch` (counted,) numbers the stretches.
    `group`: rows averaged into one. `coarse` are drives of averaged commands; in a short log the drives themselves.
    """

    drives: tuple[Drive, ...]
    coarse: tuple[Drive, ...]
    time: Float
    accel: Float | None
    speed: Float | None
    command: Float
    dt: float
    source: NDArray[np.int64]
    target: NDArray[np.int64]
    stretch: NDArray[np.int64]
    length: int
    group: int

    @property
    def rows(self) -> int:
        """Rows that count."""
        return len(self.source)

    @property
    def accel_kind(self) -> AccelKind:
        """What `accel` is, as the logs say."""
        return "specific-force" if self.drives[0].specific_force else "kinematic"

    @property
    def witnesses(self) -> tuple[str, ...]:
        return tuple(name for name in ("accel", "speed") if getattr(self, name) is not None)

    @property
    def starts(self) -> NDArray[np.int64]:
        """Where among the counted rows each stretch begins."""
        return np.flatnonzero(np.diff(self.stretch, prepend=-1))

    @classmethod
    def of(cls, logs: Log | Iterable[Log], *, rate_hz: float = RATE_HZ) -> Record:
        """From one or several logs of one car. Raises `InputError` where nothing of use is left."""
        each = [logs] if isinstance(logs, Log) else list(logs)
        if not each:
            raise InputError("logs: none given, needs one or more")
        drives: list[Drive] = []
        coarse: list[Drive] = []
        columns: dict[str, list[Float]] = {"time": [], "accel": [], "speed": [], "command": [], "use": []}
        names = list(dict.fromkeys(log.name for log in each))
        if len({(log.accel is not None, log.speed is not None) for log in each}) > 1:
            raise InputError(f"logs: {', '.join(names)} have different witnesses; needs accel, speed or both in all")
        kinds = {log.accel_kind for log in each}
        if len(kinds) > 1:
            raise InputError(f"logs: {', '.join(names)} have different kinds of accel; needs one in all")
        specific = "specific-force" in kinds
        rates = [log.rate_hz for log in each]
        if max(rates) > 1.02 * min(rates):
            told = ", ".join(f"{log.name} {log.rate_hz:.3g} Hz" for log in each)
            raise InputError(f"logs: found rates of {told}; needs one rate in all, or one diagnosis each")
        group = max(1, int(min(log.rate_hz for log in each) / rate_hz + 1e-6))
        steps = []
        for log in each:
            if log.accel_cmd is None:
                raise InputError(f"{log.name}: has no accel_cmd, which the diagnosis needs")
            for cut in rolled(log, group):
                rows = (cut.stop - cut.start) // group

                def mean(x: Float, cut: slice = cut, rows: int = rows) -> Float:
                    return x[cut].reshape(rows, group).mean(1)

                time = log.time[cut][::group]
                use = log.usable[cut].reshape(rows, group).all(1)
                settled = time - time[0] >= _SETTLE_S
                step = float(np.median(np.diff(time)))
                steps.append(step)
                speed = None if log.speed is None else mean(log.speed)
                first = max(1, round(0.3 / step))
                accel0 = None if log.accel is None else float(mean(log.accel)[:first].mean())
                raw = log.speed if log.speed is None else log.speed[cut]
                drives.append(_drive(log.time[cut], log.accel_cmd[cut], raw, accel0, specific))
                if group > 1:
                    coarse.append(_drive(time, mean(log.accel_cmd), speed, accel0, specific))
                columns["time"].append(time)
                columns["command"].append(mean(log.accel_cmd))
                columns["use"].append((use & settled).astype(float))
                for name, x in (("accel", log.accel), ("speed", log.speed)):
                    if x is not None:
                        columns[name].append(x[cut].reshape(rows, group))
        if not drives:
            raise InputError(f"{', '.join(names)}: no drive of two seconds or more, nothing to diagnose")
        dt = float(np.median(steps))
        source, target, stretch, length = _places(columns["use"], dt)
        if len(source) < 10 / dt:
            raise InputError(
                f"{', '.join(names)}: {len(source) * dt:.1f} s of usable driving (moving, engaged, "
                "2 s into each drive), needs 10 s or more"
            )

        def whole(name: str) -> Float | None:
            return np.concatenate(columns[name]) if columns[name] else None

        whole_drives = tuple(drives)
        few = group == 1 or sum(len(d.time) for d in drives) <= _FEW
        time, command = whole("time"), whole("command")
        assert time is not None
        assert command is not None
        return cls(
            drives=whole_drives,
            coarse=whole_drives if few else tuple(coarse),
            time=time,
            accel=whole("accel"),
            speed=whole("speed"),
            command=command,
            dt=dt,
            source=source,
            target=target,
            stretch=stretch,
            length=length,
            group=group,
        )

    def only(self, rows: NDArray[np.bool_]) -> Record:
        """The same drives of which only these `rows` (counted,) still count, in stretches of 2 s or more.

        Rollouts go over whole drives as before; what counts no more is neither fitted nor judged.
        """
        each = 1 if self.coarse is self.drives else self.group
        sizes = [len(d.time) * each // self.group for d in self.coarse]
        use = np.zeros(sum(sizes))
        use[self.source[rows]] = 1.0
        source, target, stretch, length = _places(np.split(use, np.cumsum(sizes)[:-1]), self.dt)
        return replace(self, source=source, target=target, stretch=stretch, length=length)

    def place(self, row: int, *, coarse: bool = False) -> Place:
        """Where a counted `row` begins in the drives, or in the `coarse` ones."""
        drives = self.coarse if coarse else self.drives
        each = 1 if self.coarse is not self.drives and coarse else self.group
        place, number = int(self.source[row]) * each, 0
        while place >= len(drives[number].time):
            place -= len(drives[number].time)
            number += 1
        return Place(number, place)

    def padded(self, values: Float) -> Float:
        """Counted rows' `values` (..., counted, group) at their places in (..., length * group), zeros between."""
        out = np.zeros((*values.shape[:-2], self.length, values.shape[-1]))
        out[..., self.target, :] = values
        return out.reshape(*values.shape[:-2], -1)

    def seen(self, responses: Sequence[Tensor], *, coarse: bool = False) -> Float:
        """Responses by drive, (..., time) each, at rows that count: (..., counted, group), `coarse` with group 1."""
        parts = []
        for x in responses:
            if coarse and self.coarse is self.drives:
                parts.append(x.unflatten(-1, (-1, self.group)).mean(-1, keepdim=True))
                continue
            if coarse:
                later = torch.cat([x[..., 1:], x[..., -1:]], -1)
                x = torch.lerp(x, later, (self.group - 1) / (2 * self.group))
            parts.append(x.unflatten(-1, (-1, 1 if coarse else self.group)))
        whole = parts[0] if len(parts) == 1 else torch.cat(parts, -2)
        return whole.numpy()[..., self.source, :]

    @cached_property
    def measured(self) -> Float:
        """What the witnesses saw, (witness, counted, group)."""
        return np.stack([x[self.source] for x in (self.accel, self.speed) if x is not None])


def rolled(log: Log, group: int) -> Iterator[slice]:
    """The rows of `log` that become a drive each: its segments of 40 groups or more, whole groups of them."""
    for part in log.segments():
        rows = (part.stop - part.start) // group
        if rows >= 2 * RATE_HZ:
            yield slice(part.start, part.start + rows * group)


def _drive(time: Float, command: Float, speed: Float | None, accel0: float | None, specific: bool) -> Drive:
    quiet = None if speed is None else torch.as_tensor(_quiet(speed, float(np.median(np.diff(time)))))
    return Drive(torch.as_tensor(_even(time)), torch.as_tensor(command), quiet, accel0, specific)


def _even(time: Float) -> Float:
    """Stamps that only jitter in their last digits are made even, so that drives are uniform."""
    even = np.linspace(time[0], time[-1], len(time))
    return even if np.abs(even - time).max() < 0.02 * (even[1] - even[0]) else time


def _quiet(speed: Float, dt: float) -> Float:
    """The measured speed without most of its noise, for what depends on speed."""
    from scipy.ndimage import gaussian_filter1d

    return np.asarray(np.maximum(gaussian_filter1d(speed, 0.15 / dt, mode="nearest"), 0.0))


def _places(use: list[Float], dt: float) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64], int]:
    source, target, stretch = [], [], []
    offset, place, number = 0, 0, 0
    gap = round(_GAP_S / dt)
    for rows in use:
        edges = np.flatnonzero(np.diff(np.concatenate([[0], rows.astype(int), [0]])))
        for begin, end in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
            if (end - begin) * dt < _SHORTEST_S:
                continue
            n = end - begin
            source.append(offset + np.arange(begin, end))
            target.append(place + np.arange(n))
            stretch.append(np.full(n, number))
            place, number = place + n + gap, number + 1
        offset += len(rows)
    empty = np.zeros(0, np.int64)
    if not source:
        return empty, empty, empty, 0
    return np.concatenate(source), np.concatenate(target), np.concatenate(stretch), place
