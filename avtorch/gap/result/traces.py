"""The drives as used in the search, with the simulator's rollouts before and after the repair."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from avtorch.arrays import FloatArray, IntArray
from avtorch.gap.budget.parts import BEGIN_S, HORIZON_S
from avtorch.gap.likelihood.record import Record
from avtorch.gap.result.uncounted import Uncounted
from avtorch.gap.simulator.plant import GapPlant


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

    @property
    def speed(self) -> FloatArray | None:
        """Measured speed, (row,); None where it was not measured."""
        return self.measured[self.channels.index("speed")] if "speed" in self.channels else None

    @cached_property
    def piece(self) -> IntArray:
        """Number (row,) of the rollout of at most `HORIZON_S` that a row belongs to; each stretch begins one."""
        firsts = np.flatnonzero(np.diff(self.stretch, prepend=self.stretch[:1] - 1))
        since = self.time - self.time[firsts][np.searchsorted(firsts, np.arange(len(self.time)), side="right") - 1]
        begins = (np.diff(self.stretch, prepend=self.stretch[:1] - 1) != 0) | (
            np.diff(since // HORIZON_S, prepend=-1.0) > 0
        )
        return np.cumsum(begins) - 1

    def begun_anew(self, simulated: FloatArray) -> FloatArray:
        """`simulated` (channel, row), with a speed that begins each `piece` at the measured one, as in the budget: over
        a whole drive it would drift without end on a car that rolls to a stop where its simulator does not.
        """
        if "speed" not in self.channels:
            return simulated
        k = self.channels.index("speed")
        off = self.measured[k] - simulated[k]
        firsts = np.flatnonzero(np.diff(self.piece, prepend=-1))
        starts = self.time - self.time[firsts][self.piece] <= BEGIN_S
        level = np.bincount(self.piece[starts], off[starts]) / np.bincount(self.piece[starts])
        out = simulated.copy()
        out[k] += level[self.piece]
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


def rolled_out(record: Record, simulator: GapPlant, onsets: Mapping[str, float] | None = None) -> FloatArray:
    """Rollouts (channel, counted, group) of a simulator over the whole drives of a record.

    `onsets` [s from the start of the one log]: from when on effects act. The response switches there, and the speed
    goes on from where it is.
    """
    late = {} if onsets is None else onsets
    waiting = sorted(late, key=late.__getitem__)
    out, time = _driven(record, simulator, waiting), record.time[record.source]
    while waiting:
        onset = late[waiting.pop(0)]
        after, acting = _driven(record, simulator, waiting), time >= onset
        if "speed" in record.channels and acting.any():
            speed, first = record.channels.index("speed"), int(np.argmax(acting))
            after[speed] += out[speed, first].mean() - after[speed, first].mean()
        out = np.where(acting[:, None], after, out)
    return out


def _driven(record: Record, simulator: GapPlant, without: Collection[str]) -> FloatArray:
    kept = [e for e in simulator.effects if e.name not in without]
    car = GapPlant(kept, T_L=simulator.T_L, K_L=simulator.K_L, sigma=simulator.sigma) if without else simulator
    responses = [car.response(drive) for drive in record.drives]
    channels = {"accel": [r.accel_measured for r in responses], "speed": [r.speed for r in responses]}
    return np.stack([record.at_counted_rows(channels[name]) for name in record.channels])
