"""Errors of rollouts over horizons, computed from one long rollout.

A rollout that restarts within a drive starts from the measurement: the acceleration from the measured one; the speed
from the measured one, with the actuator state that the commands have produced. The restart removes the error of the
long rollout at that time `t0`: permanently for the speed; for the acceleration it would have decayed with the lag. The
errors are thus `e(t) - e(t0) w(t - t0)`, where `e` is that of the long rollout and `w` is 1 or `exp(-(t - t0) / T_L)`.

All starts are equivalent and each measurement is noisy, so rollouts start at every row. The mean square of an error `x`
over all starts within a horizon of `t` is `x² - 2 x M(x) + M2(x²)`, with moving averages `M` weighted by `w` and `M2`
by its square.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from scipy.signal import lfilter

from avtorch.arrays import FloatArray
from avtorch.gap.drive_record import MeasuredRows, Record
from avtorch.gap.simulator.plant import GapPlant

HORIZON_S = 10.0
"""Of both channels: over a whole drive the speed of any model's rollout drifts away."""


def block_squares(
    record: MeasuredRows, errors: FloatArray, blocks: Sequence[slice], lag: float, horizon: float
) -> dict[str, FloatArray]:
    """Squared rollout errors of each block (block,), by metric, of a long rollout's `errors` (channel, counted, group).

    `blocks` of counted rows, each within a stretch; `lag` [s] of the actuator. Rollouts last `horizon` [s] and start at
    every measured row of a stretch, inside a block or not; the metric is named after `HORIZON_S` even where that is
    shorter.
    """
    group, dt = record.group, record.dt / record.group
    out = {f"rollout_rmse_{channel}": np.zeros(len(blocks)) for channel in record.channels}
    for begin, end in pairwise([*record.starts.tolist(), record.rows]):
        own = [j for j, b in enumerate(blocks) if begin <= b.start < end]
        within = [slice((blocks[j].start - begin) * group, (blocks[j].stop - begin) * group) for j in own]
        for channel, squares, long in zip(record.channels, out.values(), errors, strict=True):
            keeps = float(np.exp(-dt / lag)) if channel == "accel" else 1.0
            squares[own] = _squares(long[begin:end].ravel(), within, max(2, round(horizon / dt)), keeps)
    return out


def _squares(x: FloatArray, blocks: Sequence[slice], length: int, keeps: float) -> list[float]:
    """Sums of squares over each block of the errors of rollouts of `length` rows within a stretch.

    Computed from errors of a long rollout, `x` (row,), of which a row later the share `keeps` is left. Where a row has
    less than a horizon before it, rollouts start at the beginning of the stretch.
    """
    starts = np.minimum(np.arange(len(x)) + 1, length)
    mean = _window(x, length, keeps) / starts
    out = []
    for b in blocks:
        # how often each row is a start for the errors scored in this block
        scored = np.zeros(len(x))
        scored[b] = 1.0 / starts[b]
        often = _window(scored[::-1], length, keeps**2)[::-1]
        used = slice(max(b.start - length + 1, 0), b.stop)
        out.append(float(x[b] @ x[b] - 2 * x[b] @ mean[b] + (x[used] * often[used]) @ x[used]))
    return out


def _window(x: FloatArray, length: int, keeps: float) -> FloatArray:
    """Sums (row,) over the last `length` rows of `x`, each weighted by `keeps` to the power of its age."""
    if keeps < 1.0:
        ended = np.zeros_like(x)
        ended[length:] = keeps**length * x[:-length]
        return np.asarray(lfilter([1.0], [1.0, -keeps], x - ended))
    total = np.cumsum(x)
    total[length:] -= total[:-length].copy()
    return total


def rms(record: MeasuredRows, errors: FloatArray, lag: float) -> dict[str, float]:
    """Root mean square by channel of a long rollout's `errors` (channel, counted, group) in rollouts of `HORIZON_S`,
    over all counted rows; `lag` [s]."""
    edges = [*record.starts.tolist(), record.rows]
    squares = block_squares(record, errors, [slice(a, b) for a, b in pairwise(edges)], lag, HORIZON_S)
    rows = record.rows * record.group
    return {
        channel: float(np.sqrt(max(x.sum(), 0.0) / rows))
        for channel, x in zip(record.channels, squares.values(), strict=True)
    }


def reached(record: MeasuredRows, horizon: float) -> float:
    """Longest rollouts [s] of up to `horizon` [s] that the stretches hold."""
    longest = int(np.diff([*record.starts.tolist(), record.rows]).max()) * record.dt
    return min(horizon, longest)


def rolled_out(record: Record, simulator: GapPlant) -> FloatArray:
    """Rollouts (channel, counted, group) of a simulator over the whole drives of a record."""
    responses = [simulator.response(drive) for drive in record.drives]
    channels = {"accel": [r.accel_measured for r in responses], "speed": [r.speed_measured for r in responses]}
    return np.stack([record.at_counted_rows(channels[name]) for name in record.channels])
