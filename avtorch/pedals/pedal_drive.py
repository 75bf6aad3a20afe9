"""Drives as the map is fitted to them: cells of some 50 ms without a gap, and blocks of them to hold out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from avtorch.arrays import BoolArray, FloatArray, IntArray
from avtorch.errors import InputError
from avtorch.io import Log, LogSource, as_logs
from avtorch.io.mapping import PEDALS
from avtorch.pedals.pedal_map import ERROR, RATE, inputs_of, jumps

CELL_S = 0.05
BLOCK_S, SHORT_BLOCK_S = 10.0, 5.0
_BLOCKS = 6  # fewer of the long ones, and a drive is cut into short ones
_SHORTEST_S = 2.0
_FEWEST = 4


@dataclass(frozen=True, eq=False)
class Piece:
    """Cells without a gap, `dt` [s] apart: `pedals` (cell,) averaged over each, `speed` (cell + 1,) [m/s] at its
    edges, `nominal` (cell,) [m/s²] the log's own command or None, `block` (cell,): -1 where a cell does not count.
    They are of `rows` of the log of that number, `log`. Of a commanded speed, `speed_cmd` (cell,) [m/s], the `pedals`
    are its error and its slope."""

    dt: float
    pedals: dict[str, FloatArray]
    speed: FloatArray
    nominal: FloatArray | None
    block: IntArray
    log: int
    rows: slice
    speed_cmd: FloatArray | None = None

    def inputs(self, cells: IntArray, speed: FloatArray) -> dict[str, FloatArray]:
        """What the map takes in `cells` (row,), had the car the `speed` (row,) [m/s]: a loop's error is that of it."""
        out = {name: values[cells] for name, values in self.pedals.items()}
        if self.speed_cmd is not None:
            out[ERROR] = self.speed_cmd[cells] - speed
        return out

    @property
    def cells(self) -> int:
        return len(self.block)

    @property
    def middle(self) -> FloatArray:
        """Speed (cell,) [m/s], not below zero."""
        return np.maximum(0.5 * (self.speed[1:] + self.speed[:-1]), 0.0)


@dataclass(frozen=True, eq=False)
class PedalDrive:
    """All `pieces`, whose `blocks` are numbered through; `seconds` that count; `block_s`, a block's length."""

    pieces: tuple[Piece, ...]
    blocks: int
    seconds: float
    block_s: float

    @property
    def names(self) -> tuple[str, ...]:
        """The pedals."""
        return tuple(self.pieces[0].pedals)

    @property
    def is_loop(self) -> bool:
        """Whether the command is a speed."""
        return ERROR in self.names

    @property
    def has_nominal(self) -> bool:
        return all(piece.nominal is not None for piece in self.pieces)

    def counted(self, of: str) -> FloatArray:
        """`speed`, or a pedal by name, in all cells that count."""
        found = [(p.middle if of == "speed" else p.pedals[of])[p.block >= 0] for p in self.pieces]
        return np.concatenate(found)

    @classmethod
    def of(cls, logs: LogSource | Sequence[LogSource]) -> PedalDrive:
        """Raises `InputError` for logs without pedals or a commanded speed, or without speed, and for drives too short
        for four blocks."""
        each = as_logs(logs)
        names = _inputs(each)
        usable = sum(float(log.usable.sum()) / log.rate_hz for log in each)
        length = BLOCK_S if usable >= _BLOCKS * BLOCK_S else SHORT_BLOCK_S
        pieces: list[Piece] = []
        blocks = 0
        for number, log in enumerate(each):
            for part in log.segments():
                piece = _piece(log, number, part, names, length, blocks)
                if piece is not None:
                    pieces.append(piece)
                    blocks = max(blocks, int(piece.block.max()) + 1)
        if blocks < _FEWEST:
            raise InputError(f"logs: found {blocks} blocks of {length:g} s that count, needs {_FEWEST} for a map")
        seconds = sum(float((p.block >= 0).sum()) * p.dt for p in pieces)
        return cls(tuple(pieces), blocks, seconds, length)


def _inputs(logs: Sequence[Log]) -> tuple[str, ...]:
    """The pedals that all logs have and that move; without any, what a commanded speed asks of its controller."""
    names = tuple(name for name in PEDALS if logs and all(getattr(log, name) is not None for log in logs))
    is_loop = not names and bool(logs) and all(log.speed_cmd is not None for log in logs)
    asked = ("speed_cmd",) if is_loop else names
    if not asked:
        needs = f"{', '.join(PEDALS)}, or speed_cmd"
        raise InputError(f"logs: found no pedal that all of them have, needs some of {needs}")
    for log in logs:
        if log.speed is None:
            raise InputError(f"{log.name}: found no speed, needs it for a map of {' and '.join(asked)}")
    moves = tuple(
        name for name in asked if any(np.ptp(getattr(log, name)[log.usable]) > 0 for log in logs if log.usable.any())
    )
    if not moves:
        raise InputError(f"logs: found no {'speed_cmd' if is_loop else 'pedal'} that moves, needs one that does")
    if not is_loop:
        return moves
    return (ERROR,) if any(jumps(log) for log in logs) else (ERROR, RATE)


def _piece(log: Log, number: int, part: slice, names: Sequence[str], length: float, first: int) -> Piece | None:
    time = log.elapsed[part]
    row = float(np.median(np.diff(time))) if len(time) > 1 else CELL_S
    dt = row * max(1, round(CELL_S / row))
    cells = int((time[-1] - time[0]) / dt + 1e-6)
    if cells * dt < _SHORTEST_S:
        return None
    edges = time[0] + dt * np.arange(cells + 1)
    assert log.speed is not None
    inputs = inputs_of(log, names)
    usable = np.interp(edges, time, log.usable[part].astype(float)) > 0.999
    block = _blocks(usable[1:] & usable[:-1], length / dt, _SHORTEST_S / dt, first)
    return Piece(
        dt=dt,
        pedals={name: _averaged(edges, time, values[part]) for name, values in inputs.items() if values is not None},
        speed=np.interp(edges, time, log.speed[part]),
        nominal=None if log.accel_cmd is None else _averaged(edges, time, log.accel_cmd[part]),
        block=block,
        log=number,
        rows=part,
        speed_cmd=_averaged(edges, time, log.speed_cmd[part]) if ERROR in names and log.speed_cmd is not None else None,
    )


def _averaged(edges: FloatArray, time: FloatArray, values: FloatArray) -> FloatArray:
    """Means (cell,) of what is held from row to row."""
    summed = np.concatenate([[0.0], np.cumsum(values[:-1] * np.diff(time))])
    return np.diff(np.interp(edges, time, summed)) / np.diff(edges)


def _blocks(counts: BoolArray, longest: float, shortest: float, first: int) -> IntArray:
    """Runs of cells that count, each cut into equal blocks."""
    out = np.full(len(counts), -1)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], counts.astype(int), [0]])))
    for a, b in zip(edges[::2], edges[1::2], strict=True):
        if b - a < shortest:
            continue
        number = max(1, round((b - a) / longest))
        out[a:b] = first + np.minimum(np.arange(b - a) * number // (b - a), number - 1)
        first += number
    return out
