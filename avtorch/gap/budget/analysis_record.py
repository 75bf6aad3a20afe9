"""The drives as the budget takes them: every channel as an acceleration, at one modest rate, in blocks.

Sensors' noise lies mostly above a few hertz and no rollout predicts it. So commands are averaged over rows of some
50 ms (exact for what a command does to a slower actuator), speed is differenced over the same rows, and the residuals
of both channels are accelerations. Blocks of a few seconds are what is held out and what a standard error counts.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from scipy.linalg import toeplitz
from torch import Tensor

from avtorch.arrays import BoolArray, FloatArray, IntArray
from avtorch.errors import InputError
from avtorch.gap.simulator.simulator_input import SimulatorInput
from avtorch.io import Log
from avtorch.io.no_command import no_command

RATE_HZ = 20.0
"""Rows a second, about: the noise above half of this is not modelled, and only a driveline's ring shows there."""
_USUAL_LAG_S = 0.3
_ROWS_A_PERIOD = 6
_SETTLE_S = 3.0  # at the beginning of a stretch, and after rows that are masked, until the start no longer matters
_LONGEST_BLOCK_S = 10.0
_SHORTEST_BLOCK_S = 4.0
_SHORT_DRIVES_BLOCK_S = 1.0  # where drives are too short for six of the usual ones
_BLOCKS = 24  # aimed at, within those lengths
_FEWEST_BLOCKS = 6
MEMORY_S = 1.0
"""Of the noise's filter: rows that count are compared once so much of what counts is before them [s]."""
MOST_KNOTS = 36
"""Along the way, of what depends on the place."""
_LEAST_KNOT_M = 10.0
_COUNTED_SHARE = 0.4  # of a block that must count
_AT_ONCE = 64  # rows that are filtered at once


@dataclass(frozen=True, eq=False)
class Stretch:
    """Rows without a gap, `rows` of the record, and the `drive` (row,) that a plant responds to.

    `averaging` [s²]: half the variance of the window over which the readings around each row are averaged.
    """

    drive: SimulatorInput
    rows: slice
    averaging: float


@dataclass(frozen=True, eq=False)
class AnalysisRecord:
    """All stretches one after another.

    `measured` (channel, row) [m/s²]: the derivative of `speed`, and `accel`. `counts` (row,): whether a row counts.
    `block` (row,): the number of its block, -1 where it belongs to none. `time` (row,) [s] from its log's start, `log`
    (row,) the number of its log, `command` [m/s²] and `speed` [m/s] (row,), the latter zero where not measured.
    """

    stretches: tuple[Stretch, ...]
    channels: tuple[str, ...]
    measured: FloatArray
    counts: BoolArray
    block: IntArray
    time: FloatArray
    log: IntArray
    command: FloatArray
    speed: FloatArray
    dt: float

    @property
    def rows(self) -> int:
        return len(self.time)

    @property
    def blocks(self) -> int:
        return int(self.block.max(initial=-1)) + 1

    @property
    def knot_m(self) -> float:
        """Distance between the knots of what depends on the place [m]: what is driven in a block.

        In a block that is held out, its neighbours predict nothing finer; nor do other drives, unless they pass the
        same places: all of several logs begin where the first does. Along the whole way there are not more than
        `MOST_KNOTS`, as a fit's cost grows with their square.
        """
        driven = np.abs(self.speed) * self.counts * self.dt
        way = max(float(driven[self.log == log].sum()) for log in np.unique(self.log))
        return max(way / min(self.blocks, MOST_KNOTS), _LEAST_KNOT_M)

    @property
    def has_speed(self) -> bool:
        return "speed" in self.channels

    @classmethod
    def for_budget(cls, logs: Sequence[Log]) -> AnalysisRecord:
        """With blocks of the usual length, or of a second in drives too short for these.

        Raises `InputError` where what counts is less than six seconds.
        """
        try:
            return cls.of(logs)
        except InputError:
            return cls.of(logs, block_s=_SHORT_DRIVES_BLOCK_S)

    @classmethod
    def of(cls, logs: Sequence[Log], *, rate_hz: float = RATE_HZ, block_s: float | None = None) -> AnalysisRecord:
        """`block_s`: length of a block [s]; default: so that there are some 24, of four to ten seconds.

        Raises `InputError` where what counts is less than six blocks.
        """
        channels = tuple(c for c in ("speed", "accel") if all(getattr(log, c) is not None for log in logs))
        if not channels:
            raise InputError("logs: found no channel that all of them have, needs speed or accel in each")
        usable = sum(float(log.usable.sum()) / log.rate_hz for log in logs)
        length = float(np.clip(usable / _BLOCKS, _SHORTEST_BLOCK_S, _LONGEST_BLOCK_S)) if block_s is None else block_s
        slowest = min(log.rate_hz for log in logs)
        # whole rows of the slowest log, so that nothing is interpolated there
        step = max(1, int(slowest / _rate_needed(logs, rate_hz) + 1e-6)) / slowest
        pieces = [piece for number, log in enumerate(logs) for piece in _pieces(log, number, step, channels, length)]
        if not pieces:
            raise InputError(
                f"logs: found no stretch of {min(length, _SHORTEST_BLOCK_S) + _SETTLE_S + 1.0:g} s, needs some"
            )
        starts = np.cumsum([0, *(len(p.time) for p in pieces)])
        stretches = tuple(
            Stretch(p.drive, slice(a, b), p.averaging) for p, a, b in zip(pieces, starts[:-1], starts[1:], strict=True)
        )
        counts = np.concatenate([p.counts for p in pieces])
        offsets = np.cumsum([0, *(int(p.block.max()) + 1 for p in pieces)])
        block = np.concatenate([p.block + first for p, first in zip(pieces, offsets[:-1], strict=True)])
        block = _numbered(block, counts, length / step)
        record = cls(
            stretches=stretches,
            channels=channels,
            measured=np.concatenate([p.measured for p in pieces], -1),
            counts=counts & (block >= 0),
            block=block,
            time=np.concatenate([p.time for p in pieces]),
            log=np.concatenate([np.full(len(p.time), p.log) for p in pieces]),
            command=np.concatenate([p.drive.command.numpy() for p in pieces]),
            speed=np.concatenate([p.speed for p in pieces]),
            dt=step,
        )
        compared = record.with_past(round(MEMORY_S / step))
        blocks = len(np.unique(block[compared]))
        if blocks < _FEWEST_BLOCKS:
            raise InputError(
                f"logs: found {blocks} blocks of {length:g} s that count, each behind {MEMORY_S:g} s that count; "
                f"needs {_FEWEST_BLOCKS} for a budget"
            )
        return record

    def with_past(self, rows: int) -> BoolArray:
        """The rows (row,) that count, as `rows` rows before them do."""
        counts = self.counts.copy()
        for stretch in self.stretches:
            counts[stretch.rows] = _settled(self.counts[stretch.rows], rows)
        return counts

    def runs(self) -> list[slice]:
        """Rows that count without one between them that does not: through another driver's rows there is no rollout."""
        found = []
        for stretch in self.stretches:
            counts = np.concatenate([[0], self.counts[stretch.rows].astype(int), [0]])
            edges = np.flatnonzero(np.diff(counts)) + stretch.rows.start
            found += [slice(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)]
        return found

    def filtered(self, x: FloatArray, taps: FloatArray) -> FloatArray:
        """`x` (..., row) through a causal filter, each stretch by itself.

        A matrix product for each drive: every so many rows with those before them that the filter still sees.
        """
        past = len(taps) - 1
        matrix = np.asarray(toeplitz(np.append(taps[::-1], np.zeros(_AT_ONCE - 1)), np.zeros(_AT_ONCE)), float)
        out = np.empty(x.shape)
        for stretch in self.stretches:
            count = stretch.rows.stop - stretch.rows.start
            padded = np.zeros(past + -(-count // _AT_ONCE) * _AT_ONCE)
            windows = np.lib.stride_tricks.sliding_window_view(padded, past + _AT_ONCE)[::_AT_ONCE]
            for place in np.ndindex(x.shape[:-1]):
                padded[past : past + count] = x[place][stretch.rows]
                out[place][stretch.rows] = (windows @ matrix).ravel()[:count]
        return out


@dataclass(frozen=True, eq=False)
class _Piece:
    drive: SimulatorInput
    measured: FloatArray
    counts: BoolArray
    block: IntArray
    time: FloatArray
    speed: FloatArray
    log: int
    averaging: float


def _pieces(log: Log, number: int, step: float, channels: Sequence[str], length: float) -> list[_Piece]:
    if log.accel_cmd is None:
        raise no_command(log, ", needed for a budget of the gap")
    pieces, travelled = [], 0.0
    for part in log.segments():
        time = log.elapsed[part]
        rows = int((time[-1] - time[0]) / step) if len(time) > 1 else 0
        if rows * step < min(length, _SHORTEST_BLOCK_S) + _SETTLE_S + 1.0:
            continue
        grid = time[0] + step * np.arange(rows)
        edges = np.append(grid, grid[-1] + step)
        # a command is held until the next row: what it sums to is linear between rows
        summed = np.concatenate([[0.0], np.cumsum(log.accel_cmd[part][:-1] * np.diff(time))])
        command = np.diff(np.interp(edges, time, summed)) / step
        row = float(np.median(np.diff(time)))
        window = _window(max(1, round(step / row)))
        at = {c: np.interp(edges, time, _averaged(getattr(log, c)[part], window)) for c in channels}
        places = row * (np.arange(len(window)) - len(window) // 2)
        averaging = 0.5 * float(window @ places**2)
        speed = at.get("speed")
        measured = [np.diff(at["speed"]) / step if c == "speed" else at[c][:-1] for c in channels]
        usable = np.interp(grid, time, log.usable[part].astype(float)) > 0.999
        drive = SimulatorInput(
            torch.as_tensor(grid),
            torch.as_tensor(command),
            None if speed is None else torch.as_tensor(np.maximum(speed[:-1], 0.0)),
            specific_force=log.accel_kind == "specific-force",
            position0=travelled,
        )
        if drive.position is not None:
            travelled = float(drive.position[-1])
        block = np.arange(rows) * max(1, round(rows * step / length)) // rows
        settled = _settled(usable, round(_SETTLE_S / step))
        plain = np.zeros(rows) if speed is None else speed[:-1]
        pieces.append(_Piece(drive, np.stack(measured), settled, block, grid, plain, number, averaging))
    return pieces


def _rate_needed(logs: Sequence[Log], rate_hz: float) -> float:
    """`rate_hz`, or more where commands are too quick for it: a row's mean command hides what moves within the row.

    Six rows a period keep a sine's response to 5 %; the power that counts is what a usual lag lets through.
    """
    for log in logs:
        commands = () if log.accel_cmd is None else [log.accel_cmd[part] for part in log.segments()]
        for command in commands:
            if len(command) < 2:
                continue
            frequency = np.fft.rfftfreq(len(command), 1.0 / log.rate_hz)
            power = np.abs(np.fft.rfft(command - command.mean())) ** 2 / (
                1 + (2 * np.pi * frequency * _USUAL_LAG_S) ** 2
            )
            below = np.searchsorted(np.cumsum(power), 0.95 * power.sum())
            rate_hz = max(rate_hz, _ROWS_A_PERIOD * float(frequency[min(int(below), len(frequency) - 1)]))
    return rate_hz


def _window(rows: int) -> FloatArray:
    """Weights of a mean over `rows` rows, symmetric: of an even number the first and the last count half."""
    if rows % 2:
        return np.full(rows, 1.0 / rows)
    return np.concatenate([[0.5], np.ones(rows - 1), [0.5]]) / rows


def _averaged(x: FloatArray, window: FloatArray) -> FloatArray:
    """The weighted mean around each row; beyond an end, what is mirrored through the reading there: a trend goes on."""
    reach = len(window) // 2
    return np.convolve(np.pad(x, reach, mode="reflect", reflect_type="odd"), window, "valid")


def _settled(usable: BoolArray, rows: int) -> BoolArray:
    """Rows before which `rows` rows were usable too."""
    lost = np.concatenate([np.ones(rows), ~usable])
    return np.convolve(lost, np.ones(rows + 1), "valid") == 0


def _numbered(block: IntArray, counts: BoolArray, rows: float) -> IntArray:
    """Blocks numbered anew, those of which too little counts left out."""
    counted = np.bincount(block[counts], minlength=int(block.max()) + 1)
    kept = counted >= _COUNTED_SHARE * rows
    number = np.where(kept, np.cumsum(kept) - 1, -1)
    return number[block]


def stacked(responses: Sequence[Tensor]) -> FloatArray:
    """(..., channel, row) of the responses (..., row) of one stretch, a channel each."""
    return torch.stack(torch.broadcast_tensors(*responses), -2).numpy()


def later(x: FloatArray, rows: int) -> FloatArray:
    """`x` (..., row) so many `rows` later; before, its first."""
    rows = min(rows, x.shape[-1])
    return np.concatenate([np.repeat(x[..., :1], rows, -1), x[..., : x.shape[-1] - rows]], -1)
