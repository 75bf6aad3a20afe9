"""Which of a log's channels is late, and how: acceleration beside the slope of speed.

A recorder writes a channel late, by its clock, its bus or a filter, never early. So the earlier of the two is on time.
A delay that both have in common cannot be told from the car's own dead time, and counts as one.

Blocks of the drive are asked which of three explains the later channel best by the other one: a delay, either way, or
a filter of first order on either. Each block has a gain and an offset of its own, as slopes of the road and units do.
The other one is first replaced by what commands foretell of it (two-stage least squares, with commands as instruments):
a filter would else seem to help by the noise that it takes away.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import Any, Literal, NamedTuple

import numpy as np

from avtorch.arrays import BoolArray, FloatArray
from avtorch.io.clock import stretches
from avtorch.io.log import Log
from avtorch.io.validity import integral

DELAY_S = 0.6
"""Delays that are tried, either way [s]."""
FILTER_S = tuple(np.geomspace(0.05, 5.0, 25))
"""Time constants of filters that are tried [s]."""
OVER_S = 0.5
"""Both channels are averaged over this long [s], which passes what a driver commands and little of the vibration."""
BLOCK_S, LEAST_BLOCKS = 6.0, 4
"""Length of the blocks [s] whose differences tell the standard error, and how many are needed."""
SETTLED_S = 5.0
"""A filter's state is not known as a recording begins: how much of it is left out [s]."""
CLEAR = 3.0
"""Standard errors from which anything is claimed."""
AGREE = 0.2
"""Share of the late channel's variance that commands must explain by way of the other one."""
LONG_FILTER_S = 0.2
"""A shorter filter delays what a driver commands by its time constant, and takes little of it away."""
MEMORY_S = 6.0
"""How long a command is remembered by the car [s]."""
_STEP_S = 0.05
_Block = tuple[tuple[float, FloatArray], ...]


@dataclass(frozen=True)
class LateChannel:
    """A channel that is late.

    Attributes:
        name: "accel" or "speed".
        by: "delay", or "filter" of first order.
        seconds: the delay or the filter's time constant [s].
        sd: its standard error, by a jackknife over blocks of the drive [s].
        explained: share of the late channel's variance that commands explain so, by way of the other one.
    """

    name: Literal["accel", "speed"]
    by: Literal["delay", "filter"]
    seconds: float
    sd: float
    explained: float

    @property
    def recoverable(self) -> bool:
        """Whether moving the channel makes up for it (`LONG_FILTER_S`)."""
        return self.by == "delay" or self.seconds < LONG_FILTER_S

    def to_dict(self) -> dict[str, Any]:
        """Its attributes by name."""
        return asdict(self)

    def __str__(self) -> str:
        late, other = ("accel", "the slope of speed") if self.name == "accel" else ("the slope of speed", "accel")
        if self.by == "delay":
            return f"{late} comes {self.seconds:.2f} s (SE {self.sd:.1g}) after {other}"
        return f"{late} is {other} through a filter of {self.seconds:.2g} s (SE {self.sd:.1g})"


class _Tried(NamedTuple):
    """What explains one channel by the other one, with `seconds` tried: of each block the variance that is to be
    explained (block,) and what is left of it (block, seconds)."""

    seconds: FloatArray
    whole: FloatArray
    left: FloatArray

    def best(self, without: int | None = None) -> tuple[float, float]:
        """The best of `seconds`, between those tried, and the share that it explains; `without` one of the blocks."""
        whole, left = self.whole.sum(), self.left.sum(0)
        if without is not None:
            whole, left = whole - self.whole[without], left - self.left[without]
        i = int(left.argmin())
        found = float(self.seconds[i])
        if 0 < i < len(left) - 1:
            x, y = self.seconds[i - 1 : i + 2], left[i - 1 : i + 2]
            curve = np.polyfit(x - x[1], y, 2)
            found += float(np.clip(-curve[1] / (2 * curve[0]), x[0] - x[1], x[2] - x[1])) if curve[0] > 0 else 0.0
        return found, float(1 - left[i] / whole) if whole > 0 else 0.0

    def on_time(self) -> _Tried:
        """The delay of zero alone."""
        middle = [len(self.seconds) // 2]
        return _Tried(self.seconds[middle], self.whole, self.left[:, middle])

    def at_an_end(self) -> bool:
        """Whether the longest delay tried, either way, explains more than the shorter ones."""
        return int(self.left.sum(0).argmin()) in (0, len(self.seconds) - 1)


def late_channel(log: Log) -> LateChannel | None:
    """The channel of `accel` and `speed` that is clearly late (`CLEAR`), by half of a row at least; None where neither
    is, the log lacks one or commands, or commands explain so little that their order means nothing (`AGREE`).
    """
    if log.accel is None or log.speed is None or log.accel_cmd is None:
        return None
    step = 1 / log.rate_hz
    tried = stretches(log.moving & log.engaged, log.segment)
    parts = [
        one
        for x in tried
        if (one := _part(log.elapsed[x], log.speed[x], log.accel[x], log.accel_cmd[x], step)) is not None
    ]
    if not parts:
        return None
    slopes, accels = _foretold(parts)
    fine = max(step, 0.01)
    delays = fine * np.arange(-round(DELAY_S / fine), round(DELAY_S / fine) + 1, dtype=np.float64)
    blocks = [
        block
        for part, slope, accel in zip(parts, slopes, accels, strict=True)
        for block in _blocks(part, slope, accel, delays, _coarse(step))
    ]
    if len(blocks) < LEAST_BLOCKS:
        return None
    accel_late, accel_smooth, speed_late, speed_smooth = (
        _Tried(seconds, *(np.array(column) for column in zip(*(block[i] for block in blocks), strict=True)))
        for i, seconds in enumerate((delays, np.array(FILTER_S, dtype=np.float64)) * 2)
    )
    every = range(len(blocks))

    def gain(smooth: _Tried, delay: _Tried) -> float:
        """Of the best filter over the best delay, in standard errors; over none, where a longer delay were better."""
        over = delay.on_time() if delay.at_an_end() else delay
        gains = [smooth.best(i)[1] - over.best(i)[1] for i in every]
        return float(np.mean(gains) / max(_error(gains), 1e-12))

    # by the channel that is explained: both are not equally noisy
    gains = {"accel": gain(accel_smooth, accel_late), "speed": gain(speed_smooth, speed_late)}
    name: Literal["accel", "speed"] = "accel" if gains["accel"] > gains["speed"] else "speed"
    if gains[name] > CLEAR:  # whatever the time constant's error
        smooth, by = accel_smooth if name == "accel" else speed_smooth, "filter"
        seconds, explained = smooth.best()
        error = _error([smooth.best(i)[0] for i in every])
    elif not accel_late.at_an_end():
        by, (seconds, explained) = "delay", accel_late.best()
        error = _error([accel_late.best(i)[0] for i in every])
        name, seconds = ("accel", seconds) if seconds > 0 else ("speed", -seconds)
        if seconds < CLEAR * error:
            return None
    else:
        return None
    if explained < AGREE or seconds < 0.5 / log.rate_hz:
        return None
    return LateChannel(name, by, seconds, error, explained)


def on_time(log: Log, late: LateChannel) -> tuple[Log, BoolArray]:
    """The log with the late channel on time, and which rows (time,) have a value of it.

    A delayed channel is moved: each row gets the nearest recorded value, as one between two would have less noise than
    the recorder's. One behind a long filter is left out: what that has taken away does not come back, and what is left
    the other channel has too.
    """
    have = np.ones(log.rows, bool)
    if not late.recoverable:
        return replace(log, **{late.name: None}), have
    values: FloatArray = getattr(log, late.name)
    moved = values.copy()
    for part in log.segments():
        time = log.elapsed[part]
        wanted = time + late.seconds
        after = np.clip(np.searchsorted(time, wanted), min(1, len(time) - 1), len(time) - 1)
        before = np.maximum(after - 1, 0)
        moved[part] = values[part][np.where(wanted - time[before] <= time[after] - wanted, before, after)]
        have[part] = wanted <= time[-1]
    return replace(log, **{late.name: moved}), have


def _error(without: list[float]) -> float:
    """The jackknife's standard error, from the values without each of the blocks."""
    each = np.array(without)
    return float(np.sqrt((len(each) - 1) * each.var()))


class _Part(NamedTuple):
    """One stretch of a drive at even steps, averaged over `OVER_S`: the slope of speed, acceleration (row,), and the
    commands of the seconds before (row, lag)."""

    slope: FloatArray
    accel: FloatArray
    commands: FloatArray


def _part(time: FloatArray, speed: FloatArray, accel: FloatArray, command: FloatArray, step: float) -> _Part | None:
    half = step * max(round(OVER_S / 2 / step), 1)
    at = np.arange(time[0] + half, time[-1] - half, _coarse(step))
    if len(at) < (SETTLED_S + 2 * DELAY_S + BLOCK_S) / _coarse(step):
        return None

    def over(summed: FloatArray) -> FloatArray:
        return (np.interp(at + half, time, summed) - np.interp(at - half, time, summed)) / (2 * half)

    u = over(integral(time, command))
    lags = np.arange(0, round(MEMORY_S / _coarse(step)) + 1, max(round(0.1 / _coarse(step)), 1))
    commands = np.stack([np.concatenate([np.full(k, u[0]), u[: len(u) - k]]) for k in lags], 1)
    return _Part(over(speed), over(integral(time, accel)), np.column_stack([commands, np.ones(len(u))]))


def _foretold(parts: list[_Part]) -> tuple[list[FloatArray], list[FloatArray]]:
    """What commands foretell of the slope of speed and of acceleration (row,), part by part."""
    commands = np.concatenate([part.commands for part in parts])
    channels = np.concatenate([np.column_stack([part.slope, part.accel]) for part in parts])
    factors = np.linalg.lstsq(commands, channels, rcond=1e-8)[0]
    both = [part.commands @ factors for part in parts]
    return [x[:, 0] for x in both], [x[:, 1] for x in both]


def _coarse(step: float) -> float:
    """Rows of the grid [s]: a multiple of the log's, so that no value lies between two of its rows."""
    return step * max(round(_STEP_S / step), 1)


def _blocks(part: _Part, slope: FloatArray, accel: FloatArray, delays: FloatArray, step: float) -> list[_Block]:
    """Of each block of one part: what is to be explained and what is left, of accel by delays and filters of the slope,
    and of the slope by those of accel. `slope` and `accel` (row,) are what the commands foretell."""
    first, last = round((SETTLED_S + DELAY_S) / step), len(slope) - round(DELAY_S / step)
    rows = round(BLOCK_S / step)
    pairs = (
        (part.accel, _delayed(slope, delays, step)),
        (part.accel, _filtered(slope, step)),
        (part.slope, _delayed(accel, delays, step)),
        (part.slope, _filtered(accel, step)),
    )
    return [
        tuple(_left(target[begin : begin + rows], by[:, begin : begin + rows]) for target, by in pairs)
        for begin in range(first, last - rows + 1, rows)
    ]


def _delayed(values: FloatArray, delays: FloatArray, step: float) -> FloatArray:
    """The values (row,) later by each of `delays`, (delay, row)."""
    at = step * np.arange(len(values))
    return np.stack([np.interp(at - delay, at, values) for delay in delays])


def _filtered(values: FloatArray, step: float) -> FloatArray:
    """The values (row,) through filters of first order, (filter, row)."""
    # imported here: SciPy's signal takes a tenth of a second, which most commands need not spend
    from scipy.signal import lfilter

    out = []
    for seconds in FILTER_S:
        # exact for values that go straight from row to row
        keep = np.exp(-step / seconds)
        share = (1 - keep) * seconds / step
        b = [1 - share, share - keep]
        out.append(lfilter(b, [1, -keep], values, zi=[values[0] * (1 - b[0])])[0])
    return np.stack(out)


def _left(target: FloatArray, by: FloatArray) -> tuple[float, FloatArray]:
    """The target's (row,) sum of squares, and what each of `by` (tried, row) leaves of it with a gain and an offset."""
    x, y = target - target.mean(), by - by.mean(1, keepdims=True)
    whole = float(x @ x)
    return whole, np.maximum(whole - (y @ x) ** 2 / np.maximum((y**2).sum(1), 1e-300), 0.0)
