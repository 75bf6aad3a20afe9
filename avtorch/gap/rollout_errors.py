"""Errors of rollouts over horizons, computed from one long rollout.

A rollout that restarts within a drive starts from the measurement: the acceleration from the measured one; the speed
from the measured one, with the actuator state that the commands have produced. The restart removes the error of the
long rollout at that time `t0`: permanently for the speed; for the acceleration it would have decayed with the lag. The
errors are thus `e(t) - e(t0) w(t - t0)`, where `e` is that of the long rollout and `w` is 1 or `exp(-(t - t0) / T_L)`.

All starts are equivalent and each measurement is noisy, so rollouts start at every row. For two errors `x` and `y` the
mean over all starts within a horizon of `t` is `x y - x M(y) - M(x) y + M2(x y)`, with moving averages `M` weighted by
`w` and `M2` by its square.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Protocol

import numpy as np
from scipy.signal import lfilter

from avtorch.arrays import FloatArray
from avtorch.gap.counted import Counted
from avtorch.gap.drive_record import Record
from avtorch.gap.simulator.plant import GapPlant

HORIZON_S = 10.0
"""The default horizon of both channels, used where a name states none: over a whole drive the speed of any model's
rollout drifts away."""
HORIZONS_S = (0.5, 2.0, HORIZON_S)


class ErrorMetric(Protocol):
    """A measure computed from the errors of long rollouts of a `channel`, over `horizon_s` [s]."""

    @property
    def channel(self) -> str: ...
    @property
    def horizon_s(self) -> float | None: ...
    def products(self, x: FloatArray, blocks: Sequence[slice], dt: float, lag: float, /) -> FloatArray: ...


@dataclass(frozen=True)
class RolloutMetric:
    """A measure of rollout error: of a `channel`, over rollouts of `horizon_s` [s]; None: the whole drive's."""

    channel: str
    horizon_s: float | None

    @property
    def name(self) -> str:
        over = {HORIZON_S: "", None: "_whole"}.get(self.horizon_s, f"_{self.horizon_s or 0:g}s")
        return f"rollout_rmse_{self.channel}{over}"

    def products(self, x: FloatArray, blocks: Sequence[slice], dt: float, lag: float) -> FloatArray:
        """(block, one, other): sums over each block of products of the errors of rollouts within a stretch.

        Computed from errors of a long rollout, `x` (one, row) of this channel; `dt` [s] between rows, `lag` [s] of the
        actuator. Where a row has less than a horizon before it, rollouts start at the beginning of the stretch.
        """
        if self.horizon_s is None:
            whole = x - x[:, :1] if self.channel == "speed" else x
            return np.stack([whole[:, b] @ whole[:, b].T for b in blocks])
        length = max(2, round(self.horizon_s / dt))
        keeps = float(np.exp(-dt / lag)) if self.channel == "accel" else 1.0
        starts = np.minimum(np.arange(x.shape[1]) + 1, length)
        mean = _window(x, length, keeps) / starts
        out = []
        for b in blocks:
            # how often each row is a start for the errors scored in this block
            scored = np.zeros(x.shape[1])
            scored[b] = 1.0 / starts[b]
            often = _window(scored[::-1], length, keeps**2)[::-1]
            used = slice(max(b.start - length + 1, 0), b.stop)
            mixed = x[:, b] @ mean[:, b].T
            squares = (x[:, used] * often[used]) @ x[:, used].T
            out.append(x[:, b] @ x[:, b].T - mixed - mixed.T + squares)
        return np.stack(out)


def _window(x: FloatArray, length: int, keeps: float) -> FloatArray:
    """Sums (..., row) over the last `length` rows of `x`, each weighted by `keeps` to the power of its age."""
    if keeps < 1.0:
        ended = np.zeros_like(x)
        ended[..., length:] = keeps**length * x[..., :-length]
        return np.asarray(lfilter([1.0], [1.0, -keeps], x - ended))
    total = np.cumsum(x, -1)
    total[..., length:] -= total[..., :-length].copy()
    return total


def products(
    metric: ErrorMetric, record: Record | Counted, errors: FloatArray, blocks: Sequence[slice], lag: float
) -> FloatArray:
    """(block, one, other): sums of products of `errors` (one, channel, counted, group) of long rollouts, by a measure.

    `blocks` of counted rows, each within a stretch; `lag` [s]. Rollouts start at every measured row of a stretch,
    inside a held-out block or not.
    """
    long = errors[:, record.channels.index(metric.channel)]
    group, out = record.group, np.zeros((len(blocks), len(errors), len(errors)))
    for begin, end in pairwise([*record.starts.tolist(), record.rows]):
        own = [j for j, b in enumerate(blocks) if begin <= b.start < end]
        if own:
            rows = long[:, begin:end].reshape(len(errors), -1)
            within = [slice((blocks[j].start - begin) * group, (blocks[j].stop - begin) * group) for j in own]
            out[own] = metric.products(rows, within, record.dt / group, lag)
    return out


def block_squares(
    record: Record | Counted, errors: FloatArray, blocks: Sequence[slice], lag: float, horizon: float
) -> dict[str, FloatArray]:
    """Squared rollout errors of each block (block,), by metric, of a long rollout's `errors` (channel, counted, group).

    Rollouts last `horizon` [s]; the metric is named after `HORIZON_S` even where that is shorter.
    """
    out: dict[str, FloatArray] = {}
    for channel in record.channels:
        squares = products(RolloutMetric(channel, horizon), record, errors[None], blocks, lag)
        out[RolloutMetric(channel, HORIZON_S).name] = squares[:, 0, 0]
    return out


def rms(metric: RolloutMetric, record: Record | Counted, errors: FloatArray, lag: float) -> float:
    """Root mean square of a long rollout's `errors` (channel, counted, group) by a measure, over all counted rows;
    `lag` [s]."""
    edges = [*record.starts.tolist(), record.rows]
    total = products(metric, record, errors[None], [slice(a, b) for a, b in pairwise(edges)], lag).sum()
    return float(np.sqrt(total / (record.rows * record.group)))


def reached(metric: ErrorMetric, record: Record | Counted) -> float | None:
    """Longest rollouts [s] of a measure that the stretches hold; None: as long as the stretches."""
    if metric.horizon_s is None or not np.isfinite(metric.horizon_s):
        return None
    longest = int(np.diff([*record.starts.tolist(), record.rows]).max()) * record.dt
    return min(metric.horizon_s, longest)


def rollout_metrics(channels: Iterable[str]) -> tuple[RolloutMetric, ...]:
    """All measures of these channels: over each horizon, and over whole drives."""
    return tuple(RolloutMetric(w, h) for w in channels for h in (*HORIZONS_S, None))


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
