"""What a map is worth: rollouts of speed over blocks that it was not fitted to, beside those of simpler demands.

Each rollout begins at the measured speed and goes on by its own: what depends on speed is taken at the speed that is
rolled out. Lag and dead time are fitted to each demand by itself, without the block.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from avtorch.arrays import FloatArray, IntArray
from avtorch.io import Log, LogSource, as_logs
from avtorch.pedals.fit_map import fit_drive
from avtorch.pedals.lagged import bounded_solution, delayed, lag_of, normal_equations, rows_of, speed_gained
from avtorch.pedals.pedal_drive import PedalDrive, Piece
from avtorch.pedals.pedal_map import SIGN, PedalMap

_BEGIN_S = 0.5  # over which the speed at the beginning is averaged
_ROUNDS = 4

Demand = Callable[[Piece, FloatArray, IntArray], FloatArray]
"""The acceleration demanded (block,) in cells (block,) of a piece at speeds (block,)."""


@dataclass(frozen=True, eq=False)
class HeldOut:
    """Mean squared errors of speed `squares` (block,) [m²/s²] by model: `map`, `factor` (one constant for each pedal)
    and, where the log has a command of its own, `nominal`. `horizon_s`: length of the rollouts, which are the blocks.

    Example:
        >>> import numpy as np
        >>> from avtorch.pedals import HeldOut
        >>> better = HeldOut({"map": np.array([0.1, 0.2, 0.1]), "factor": np.array([1.0, 1.3, 1.1])}, 10.0)
        >>> round(better.rmse("factor"), 2), better.better_than("factor")
        (1.06, True)
    """

    squares: Mapping[str, FloatArray]
    horizon_s: float

    def rmse(self, model: str) -> float:
        """Root of the mean squared error of speed [m/s]."""
        return float(np.sqrt(self.squares[model].mean()))

    def gain(self, over: str, *, of: str = "map") -> tuple[float, float]:
        """By how much the squared error of `of` is below that of `over`, block by block, and its standard error."""
        less = self.squares[over] - self.squares[of]
        return float(less.mean()), float(less.std(ddof=1) / np.sqrt(len(less)))

    def better_than(self, over: str) -> bool:
        """Whether the map's gain is above two of its standard errors."""
        gain, error = self.gain(over)
        return gain > 2 * error


def held_out(logs: LogSource | Sequence[LogSource]) -> HeldOut:
    """Scores maps that are fitted without a fifth of the blocks on that fifth, each in its turn.

    Raises `InputError` as `fit_pedals` does.

    Example:
        >>> import numpy as np
        >>> from avtorch import Log
        >>> from avtorch.pedals import held_out
        >>> time = np.arange(0.0, 120.0, 0.05)
        >>> throttle = 0.25 + 0.15 * np.sin(0.4 * time) + 0.1 * np.sin(1.1 * time)
        >>> speed = np.empty(len(time))
        >>> v, a = 10.0, 0.0
        >>> for i, pedal in enumerate(throttle):  # 4 m/s² at full throttle, a lag of 0.4 s, and drag
        ...     speed[i] = v
        ...     v, a = v + 0.05 * a, a + 0.05 / 0.4 * (4.0 * pedal - 0.1 * v - a)
        >>> held_out(Log.from_arrays(time=time, throttle=throttle, speed=speed)).better_than("factor")
        True
    """
    drive = PedalDrive.of(logs)
    models = ("nominal", "factor", "map") if drive.has_nominal else ("factor", "map")
    squares = {model: np.full(drive.blocks, np.nan) for model in models}
    folds = min(FOLDS, drive.blocks)
    for fold in range(folds):
        out = np.arange(drive.blocks) % folds == fold
        for model in models:
            demand, T_L, dead_time = _fitted(model, drive, ~out)
            scored = roll_out(drive, demand, T_L, dead_time)
            squares[model][out] = scored[out]
    return HeldOut(squares, drive.block_s)


def map_demand(made: PedalMap) -> Demand:
    """The demand of a map."""
    return lambda piece, speed, cells: made.accel(speed, **piece.inputs(cells, speed))


def _fitted(model: str, drive: PedalDrive, used: np.ndarray) -> tuple[Demand, float, float]:
    if model == "map":
        made = fit_drive(drive, used, errors=False).map
        return map_demand(made), made.T_L, made.dead_time
    rows = rows_of(drive)

    def columns(piece: Piece) -> FloatArray:
        if model == "nominal":
            assert piece.nominal is not None
            return piece.nominal[:, None]
        return np.column_stack([SIGN[name] * x for name, x in piece.pedals.items()])

    factors, T_L, dead_time = np.ones(columns(drive.pieces[0]).shape[1]), 0.3, 0.0
    for _ in range(_ROUNDS):
        if model == "factor":
            products = normal_equations(rows, columns, T_L, dead_time, drive.blocks)[used].sum(0)
            factors = bounded_solution(products[:-1, :-1], products[:-1, -1], 0)
        before = T_L, dead_time
        T_L, dead_time = lag_of(rows, [columns(one.piece) @ factors for one in rows], used)
        if (T_L, dead_time) == before:
            break
    if model == "nominal":
        return lambda piece, speed, cells: columns(piece)[cells, 0], T_L, dead_time

    def demand(piece: Piece, speed: FloatArray, cells: IntArray) -> FloatArray:
        given = piece.inputs(cells, speed)
        return np.column_stack([SIGN[name] * given[name] for name in piece.pedals]) @ factors

    return demand, T_L, dead_time


def roll_out(drive: PedalDrive, demand: Demand, T_L: float, dead_time: float) -> FloatArray:
    """Mean squared errors of speed (block,) [m²/s²] over each block of a drive."""
    out = np.full(drive.blocks, np.nan)
    for piece in drive.pieces:
        inside = np.flatnonzero(piece.block >= 0)
        if not len(inside):
            continue
        numbers, first, length = np.unique(piece.block[inside], return_index=True, return_counts=True)
        start = inside[first]
        cells = np.arange(piece.cells)
        whole = demand(piece, piece.middle, cells)
        _, accel = speed_gained(delayed(whole, dead_time, piece.dt), T_L, piece.dt)
        out[numbers] = _errors(piece, demand, T_L, dead_time, start, length, accel[start])
    return out


def _errors(
    piece: Piece, demand: Demand, T_L: float, dead_time: float, start: IntArray, length: IntArray, accel: FloatArray
) -> FloatArray:
    dt, keep = piece.dt, np.exp(-piece.dt / T_L)
    begin = max(1, round(_BEGIN_S / dt))
    whole, part = int(dead_time / dt), dead_time / dt - int(dead_time / dt)
    # the speed at the beginning: the mean about it of what is measured, on the line through it
    around = np.clip(start[:, None] + np.arange(-(begin // 2), begin // 2 + 1), 0, piece.cells)
    v, a = piece.speed[around].mean(1), accel.copy()
    total, rolled = np.zeros(len(start)), np.empty((int(length.max()), len(start)))
    for step in range(int(length.max())):
        at = np.minimum(start + step, piece.cells - 1)
        inside = step < length
        total += np.where(inside, (v - piece.speed[at]) ** 2, 0.0)
        rolled[step] = v
        now, then = (_late(piece, demand, rolled, at, step, cells) for cells in (whole, whole + 1))
        m = (1 - part) * now + part * then
        v = np.maximum(v + m * dt + (a - m) * T_L * (1 - keep), 0.0)
        a = keep * a + (1 - keep) * m
    return total / length


def _late(piece: Piece, demand: Demand, rolled: FloatArray, at: IntArray, step: int, cells: int) -> FloatArray:
    """The demand (block,) of so many `cells` ago: of pedals at the speed of now, which slows the car at once; of a loop
    at the one that its controller saw then, rolled out, or measured before the beginning."""
    past = np.maximum(at - cells, 0)
    if piece.speed_cmd is None:
        return demand(piece, np.maximum(rolled[step], 0.0), past)
    return demand(piece, np.maximum(rolled[step - cells], 0.0) if step >= cells else piece.middle[past], past)


FOLDS = 5


def crossed(logs: LogSource | Sequence[LogSource]) -> list[Log]:
    """The same drives with `accel_cmd` (row,), in each block of some ten seconds by the map of the other folds' blocks.

    What is scored on these commands, such as a budget of the gap, is then scored on a map that was held out. Raises
    `InputError` as `fit_pedals` does.

    Example:
        >>> import numpy as np
        >>> from avtorch import Log
        >>> from avtorch.pedals import crossed, fit_pedals
        >>> time = np.arange(0.0, 60.0, 0.05)
        >>> throttle = 0.3 + 0.2 * np.sin(0.5 * time)
        >>> speed = 15.0 + 1.2 * np.sin(0.5 * time - np.pi / 2)
        >>> log = Log.from_arrays(time=time, throttle=throttle, speed=speed)
        >>> bool(np.corrcoef(crossed(log)[0].accel_cmd, fit_pedals(log).map.commanded(log).accel_cmd)[0, 1] > 0.95)
        True
    """
    each = as_logs(logs)
    drive = PedalDrive.of(each)
    whole = fit_drive(drive, errors=False).map
    commands = [whole.commanded(log).accel_cmd for log in each]
    for fold in range(FOLDS):
        out = np.arange(drive.blocks) % FOLDS == fold
        if not out.any():
            continue
        made = fit_drive(drive, ~out, errors=False).map
        others = [made.commanded(log).accel_cmd for log in each]
        for piece in drive.pieces:
            time = each[piece.log].elapsed[piece.rows]
            cell = np.clip(((time - time[0]) / piece.dt).astype(int), 0, piece.cells - 1)
            block = piece.block[cell]
            rows = np.arange(piece.rows.start, piece.rows.stop)[(block >= 0) & out[block]]
            target, source = commands[piece.log], others[piece.log]
            assert target is not None
            assert source is not None
            target[rows] = source[rows]
    return [replace(log, accel_cmd=command) for log, command in zip(each, commands, strict=True)]
