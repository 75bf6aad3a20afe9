"""Drives as the map is fitted to them: steps of a tenth of a second without a gap, and the command of all pedals."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.optimize import nnls

from avtorch.arrays import BoolArray, FloatArray
from avtorch.errors import InputError
from avtorch.gap.result.output_error import STEP_S
from avtorch.io import Log, LogSource, as_logs
from avtorch.io.clock import stretches
from avtorch.io.mapping import PEDALS
from avtorch.pedals.pedal_map import ERROR, RATE, SIGN, inputs_of, jumps

_SHORTEST_S = 3.0  # of a stretch
_SMOOTH_S = 0.1
_SLOPE_S = 1.0  # over which accelerations are compared with pedals
_LATE_S = (0.0, 0.1, 0.2, 0.3, 0.5, 0.8)
_LEAST = 0.1  # of the acceleration that moves with a pedal: a driver who holds a speed shows none


@dataclass(frozen=True, eq=False)
class PedalDrive:
    """Rows `dt` [s] apart: means of the `pedals` (row,) over the step that begins there, and the `speed` (row,) [m/s];
    `starts` (row,) of stretches. Of a commanded speed the `pedals` are its error and slope.
    """

    dt: float
    pedals: Mapping[str, FloatArray]
    speed: FloatArray
    starts: BoolArray

    @property
    def is_loop(self) -> bool:
        """Whether the command is a speed."""
        return ERROR in self.pedals

    @property
    def seconds(self) -> float:
        return len(self.speed) * self.dt

    @classmethod
    def of(cls, logs: LogSource | Sequence[LogSource]) -> PedalDrive:
        """Raises `InputError` for logs without pedals or a commanded speed, or without speed."""
        each = as_logs(logs)
        names = _inputs(each)
        dt = max(STEP_S, *(1 / log.rate_hz for log in each)) if each else STEP_S
        columns: dict[str, list[FloatArray]] = {name: [] for name in (*names, "speed", "starts")}
        for log in each:
            inputs = inputs_of(log, names)
            for part in stretches(log.usable, log.segment):
                time = log.elapsed[part]
                count = int((time[-1] - time[0]) / dt + 1e-6)
                if count * dt < _SHORTEST_S:
                    continue
                assert log.speed is not None
                edges = time[0] + dt * np.arange(count + 1)
                smooth = gaussian_filter1d(np.interp(edges, time, log.speed[part]), _SMOOTH_S / dt)
                columns["speed"].append(np.maximum(smooth[:-1], 0.0))
                columns["starts"].append(np.arange(count) == 0)
                for name in names:
                    values = log.speed_cmd if name == ERROR else inputs[name]
                    assert values is not None
                    mean = _averaged(edges, time, values[part])
                    # of the error no noise is left that the run's own speed does not take away again
                    columns[name].append(mean - 0.5 * (smooth[:-1] + smooth[1:]) if name == ERROR else mean)
        if not columns["speed"]:
            raise InputError(f"logs: found no stretch of {_SHORTEST_S:g} s that counts, needs some for a map")
        whole = {name: np.concatenate(parts) for name, parts in columns.items()}
        return cls(dt, {name: whole[name] for name in names}, whole["speed"], whole["starts"].astype(bool))

    def late(self, x: FloatArray, seconds: float) -> FloatArray:
        """Values (row,) so much later; before a stretch they were as at its first row."""
        at = np.arange(len(x))
        first = np.maximum.accumulate(np.where(self.starts, at, 0))
        whole, part = int(seconds / self.dt), seconds / self.dt - int(seconds / self.dt)
        return (1 - part) * x[np.maximum(at - whole, first)] + part * x[np.maximum(at - whole - 1, first)]

    @cached_property
    def factors(self) -> Mapping[str, float]:
        """What one constant each makes of the pedals [m/s² a unit]: the command beyond which there is a map."""
        if self.is_loop:
            return dict.fromkeys(self.pedals, 1.0)
        width = round(_SLOPE_S / self.dt)
        rows = np.arange(0, len(self.speed) - width, max(1, width // 4))
        stretch = np.cumsum(self.starts)
        rows = rows[stretch[rows] == stretch[rows + width]]
        slope = (self.speed[rows + width] - self.speed[rows]) / (width * self.dt)
        free = np.column_stack([np.ones(len(rows)), self.speed[rows]])

        def beside(x: FloatArray) -> FloatArray:  # what no resistance explains
            return x - free @ np.linalg.lstsq(free, x, rcond=None)[0]

        best, found = np.inf, np.zeros(len(self.pedals))
        spread = np.ones(len(self.pedals))
        for seconds in _LATE_S:
            means = [np.append(0.0, np.cumsum(SIGN[n] * self.late(x, seconds))) for n, x in self.pedals.items()]
            X = np.column_stack([(m[rows + width] - m[rows]) / width for m in means])
            x, left = nnls(beside(X), beside(slope))
            if left < best:
                best, found, spread = left, x, np.maximum(X.std(0), 1e-12)
        least = _LEAST * float(slope.std()) / spread
        return dict(zip(self.pedals, np.maximum(found, least).tolist(), strict=True))

    @cached_property
    def command(self) -> FloatArray:
        """What the pedals ask for (row,) [m/s²] by their factors; the error of a commanded speed [m/s]."""
        if self.is_loop:
            return self.pedals[ERROR]
        return np.sum([SIGN[name] * self.factors[name] * x for name, x in self.pedals.items()], axis=0)

    @property
    def feed(self) -> FloatArray | None:
        """How fast a commanded speed moves (row,) [m/s²]; None for pedals."""
        return self.pedals.get(RATE, np.zeros_like(self.speed)) if self.is_loop else None


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


def _averaged(edges: FloatArray, time: FloatArray, values: FloatArray) -> FloatArray:
    """Means (step,) of what is held from row to row."""
    summed = np.concatenate([[0.0], np.cumsum(values[:-1] * np.diff(time))])
    return np.diff(np.interp(edges, time, summed)) / np.diff(edges)
