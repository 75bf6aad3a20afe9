"""A simulator's output on the rows of a car's log: the same commands, perhaps another clock and another rate.

Clocks are brought together by the commands, which both have. A simulator's output is smooth, so between its rows it is
interpolated; the car's readings stay as they are.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from avtorch.arrays import BoolArray, FloatArray
from avtorch.errors import InputError
from avtorch.io import Log

_FARTHEST_S = 30.0  # that two clocks may be apart beyond what their first rows say
_GRID_S = 0.005
_SAME = 0.05  # of the command's standard deviation, by which two commands may differ (root mean square)


@dataclass(frozen=True)
class Aligned:
    """`log`: the simulator's output in the car's rows; `offset_s`: what its clock was ahead of the car's [s]."""

    log: Log
    offset_s: float


def aligned(simulated: Log, log: Log) -> Aligned:
    """The output `simulated` in the rows of the car's `log`.

    Where both have commands, the clocks are shifted until these agree; where the output has none, both are taken to
    begin at the same moment, unless their clocks overlap. Rows of the car that the output does not cover are marked as
    not `engaged`, so that they do not count.

    Raises `InputError` for other commands than the car's, or an output that covers less than half of the car's rows.
    """
    if simulated.accel is None and simulated.speed is None:
        raise InputError(f"{simulated.name}: has neither accel nor speed, needs one of the two")
    shift = _shift(simulated, log)
    time = log.elapsed + shift
    inside = _covered(simulated, time)
    if inside.mean() < 0.5:
        raise InputError(
            f"{simulated.name}: covers {inside.mean():.0%} of the rows of {log.name}; needs the same drive, of "
            f"{log.elapsed[-1]:.6g} s"
        )
    channels = {
        name: None if values is None else np.interp(time, simulated.elapsed, values)
        for name, values in (("accel", simulated.accel), ("speed", simulated.speed))
    }
    if simulated.accel_cmd is not None and log.accel_cmd is not None:
        _check_commands(simulated, log, time, inside & log.engaged)
    whole = replace(log, name=simulated.name, engaged=log.engaged & inside, **channels)
    return Aligned(whole, shift + simulated.epoch_s - log.epoch_s)


def _shift(simulated: Log, log: Log) -> float:
    """What is added to the car's elapsed time for the simulator's [s]."""
    apart = log.epoch_s - simulated.epoch_s
    overlap = -log.elapsed[-1] < apart < simulated.elapsed[-1]
    begun = apart if overlap else 0.0
    if simulated.accel_cmd is None or log.accel_cmd is None:
        return begun
    from scipy.signal import correlate, correlation_lags

    grid = np.arange(-_FARTHEST_S, log.elapsed[-1] + _FARTHEST_S, _GRID_S)
    one = _standard(_held(log.elapsed, log.accel_cmd, grid))
    other = _standard(_held(simulated.elapsed - begun, simulated.accel_cmd, grid))
    shared = correlate(other, one, mode="full", method="fft")
    lags = correlation_lags(len(other), len(one))
    near = np.abs(lags) <= _FARTHEST_S / _GRID_S
    best = int(lags[near][np.argmax(shared[near])])
    # commands that agree as they are stay where they are
    still = shared[lags == 0][0]
    return begun if shared[near].max() <= 1.001 * still else begun + best * _GRID_S


def _held(time: FloatArray, values: FloatArray, grid: FloatArray) -> FloatArray:
    """`values` held from row to row, zero outside."""
    row = np.searchsorted(time, grid + 1e-9, side="right") - 1
    return np.where((row >= 0) & (grid <= time[-1]), values[np.maximum(row, 0)], 0.0)


def _standard(x: FloatArray) -> FloatArray:
    return x - x.mean()


def _covered(simulated: Log, time: FloatArray) -> BoolArray:
    """Rows that lie within a segment of the output."""
    inside = np.zeros(len(time), dtype=bool)
    for part in simulated.segments():
        own = simulated.elapsed[part]
        inside |= (time >= own[0] - 1e-6) & (time <= own[-1] + 1e-6)
    return inside


def _check_commands(simulated: Log, log: Log, time: FloatArray, rows: BoolArray) -> None:
    assert simulated.accel_cmd is not None
    assert log.accel_cmd is not None
    other = _held(simulated.elapsed, simulated.accel_cmd, time)
    # a row's command may change within the other's row: the better of two neighbours
    late = _held(simulated.elapsed, simulated.accel_cmd, time - 1.0 / simulated.rate_hz)
    apart = np.minimum(np.abs(other - log.accel_cmd), np.abs(late - log.accel_cmd))[rows]
    size = float(log.accel_cmd[rows].std())
    if size and float(np.sqrt((apart**2).mean())) > _SAME * size:
        raise InputError(
            f"{simulated.name}: its accel_cmd differs from that of {log.name} by {np.sqrt((apart**2).mean()):.2g} m/s² "
            f"(root mean square, commands have a standard deviation of {size:.2g}); needs the simulator driven by the "
            "car's own commands, in an open loop"
        )
