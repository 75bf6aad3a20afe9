"""The drives as used in the search: rollouts before and after the repair, what did not count, alarms of a monitor."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Literal, Self

import numpy as np

from avtorch.arrays import FloatArray, IntArray
from avtorch.gap.result.counted_rows import HORIZON_S, CountedRows, free_runs, runs_over
from avtorch.io import Log

Reason = Literal["driver", "standstill", "gap", "settling"]
_REASONS: tuple[Reason, ...] = ("driver", "standstill", "settling")


@dataclass(frozen=True)
class Uncounted:
    """From `begin` to `end` [s from the start of its log] nothing counted, because of `why`; `log`: which of the logs
    that have rows that count, from 0.

    "driver": the command was not in force; "standstill"; "gap": no rows; "settling": the first seconds of a drive and
    of each return to the command, whose state is not known, and pieces too short to count.
    """

    begin: float
    end: float
    why: Reason
    log: int = 0


@dataclass(frozen=True)
class Alarm:
    """An alarm of `detector` that began `at` [s] from the start of log number `log`, when its window ended."""

    at: float
    detector: str
    log: int = 0


@dataclass(frozen=True, eq=False)
class Traces:
    """Counted rows, averaged to about 20 Hz. Accelerations [m/s²], speed [m/s], `time` [s] from their log's start.

    `command` (row,); `measured`, `before`, `after` (channel, row): measurements, and rollouts over whole drives of the
    fitted simulator without and with the effect (equal where nothing was named). `does` (row,) [nats]: the effect's
    contribution in each row. `stretch` (row,) numbers the stretches without gaps; `uncounted`: what lies between them.
    """

    time: FloatArray
    command: FloatArray
    channels: tuple[str, ...]
    measured: FloatArray = field(repr=False)
    before: FloatArray = field(repr=False)
    after: FloatArray = field(repr=False)
    does: FloatArray = field(repr=False)
    stretch: IntArray = field(repr=False)
    uncounted: tuple[Uncounted, ...] = field(default=(), repr=False)

    @classmethod
    def of(
        cls, rows: CountedRows, before: FloatArray, after: FloatArray, does: FloatArray, logs: Sequence[Log] = ()
    ) -> Self:
        """Of counted rows; `before`, `after` (channel, row, group): the simulator's. `logs`: for what did not count."""
        measured, before, after = (x.mean(-1) for x in (rows.measured, before, after))
        left_out = uncounted(logs, rows) if logs else ()
        return cls(rows.time, rows.command, rows.channels, measured, before, after, does, rows.stretch, left_out)

    @property
    def step(self) -> float:
        """Time between rows [s]."""
        inside = np.diff(self.stretch) == 0
        return float(np.median(np.diff(self.time)[inside])) if inside.any() else 0.05

    @property
    def stretches(self) -> list[IntArray]:
        """Rows of each stretch without gaps."""
        return np.split(np.arange(len(self.time)), np.flatnonzero(np.diff(self.stretch)) + 1)

    @property
    def log(self) -> IntArray:
        """Number (row,) of the log of each row, from 0."""
        return np.cumsum(np.diff(self.time, prepend=self.time[:1]) < 0, dtype=np.int64)

    @property
    def speed(self) -> FloatArray | None:
        """Measured speed, (row,); None where it was not measured."""
        return self.measured[self.channels.index("speed")] if "speed" in self.channels else None

    @property
    def runs(self) -> list[slice]:
        """Rows of free runs of at most `HORIZON_S`; each stretch begins one."""
        parts = [slice(int(rows[0]), int(rows[-1]) + 1) for rows in self.stretches]
        return runs_over(parts, round(HORIZON_S / self.step))

    @property
    def piece(self) -> IntArray:
        """Number (row,) of the run that a row belongs to."""
        return np.repeat(np.arange(len(self.runs)), [run.stop - run.start for run in self.runs])

    def begun_anew(self, simulated: FloatArray) -> FloatArray:
        """`simulated` (channel, row), with a speed that begins each of the `runs` at the measured one: over a whole
        drive it would drift without end on a car that rolls to a stop where its simulator does not.
        """
        if "speed" not in self.channels:
            return simulated
        k, out = self.channels.index("speed"), simulated.copy()
        out[k] = self.measured[k] - free_runs(self.measured[k] - simulated[k], self.runs, self.step)
        return out

    def accelerations(self, over_s: float) -> tuple[FloatArray, ...]:
        """Measured and simulated, `before` and `after`: (row,) [m/s²] each. Where none was measured, slopes of the
        speeds about each row over `over_s` [s]; at the ends of a stretch those of the nearest row that has one."""
        k = self.channels.index("accel") if "accel" in self.channels else None
        each = (x[k or 0] for x in (self.measured, self.before, self.after))
        return tuple(self._slope(x, over_s) if k is None else x for x in each)

    def _slope(self, speed: FloatArray, over_s: float) -> FloatArray:
        out, step = np.empty_like(speed), self.step
        for rows in self.stretches:
            width = min(max(2, 2 * round(over_s / step / 2)), len(rows) - 1)
            slope = (speed[rows[width:]] - speed[rows[: len(rows) - width]]) / (max(width, 1) * step)
            out[rows] = slope[np.clip(np.arange(len(rows)) - width // 2, 0, len(slope) - 1)]
        return out

    def fit(self, simulated: FloatArray) -> FloatArray:
        """Fit [%] of `simulated` (channel, row), such as `before` or `after`, to what was measured: (channel,), a speed
        `begun_anew`.

        100 (1 - |y - y_sim| / |y - mean(y)|), the fit by normalised root mean square error of system identification
        (Ljung, System Identification, 2nd ed., 1999): 100 is exact, 0 no better than the mean, less is worse than it.
        NaN for a channel that stands still.
        """
        error = np.linalg.norm(self.measured - self.begun_anew(simulated), axis=1)
        spread = np.linalg.norm(self.measured - self.measured.mean(axis=1, keepdims=True), axis=1)
        return 100 * (1 - np.divide(error, spread, out=np.full_like(error, np.nan), where=spread > 0))


def uncounted(logs: Sequence[Log], record: CountedRows) -> tuple[Uncounted, ...]:
    """What `record`, made of these `logs`, does not count, in order of time."""
    found: list[Uncounted] = []
    for number, counted in enumerate(np.unique(record.log).tolist()):
        log = logs[counted]
        counts = record.time[record.log == counted]
        why = np.full(log.rows, _REASONS.index("settling"))
        # averaged rows: from the stamp of the first of each to the next
        last = np.searchsorted(counts, log.elapsed + 1e-6 * record.dt, side="right") - 1
        why[(last >= 0) & (log.elapsed - counts[last] < (1 - 1e-3) * record.dt)] = -1
        why[(why >= 0) & ~log.moving] = _REASONS.index("standstill")
        why[(why >= 0) & ~log.engaged] = _REASONS.index("driver")
        for part, after in pairwise([*log.segments(), None]):
            assert part is not None
            edges = [part.start, *(np.flatnonzero(np.diff(why[part])) + 1 + part.start).tolist(), part.stop]
            for a, b in pairwise(edges):
                if why[a] >= 0:
                    end = log.elapsed[min(b, part.stop - 1)]
                    found.append(Uncounted(float(log.elapsed[a]), float(end), _REASONS[why[a]], number))
            if after is not None:
                ends = float(log.elapsed[part.stop - 1]), float(log.elapsed[after.start])
                if ends[1] - ends[0] > 2 * record.dt:
                    found.append(Uncounted(*ends, "gap", number))
    return tuple(found)
