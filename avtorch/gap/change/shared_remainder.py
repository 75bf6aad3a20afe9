"""What GLVD leaves of this car, as a regression that holds before and after: smooth in commands, rollout and speed.

Time is not among its columns: what a drive does at one moment says nothing of another drive. The remainder stands for
every effect that the car has on both sides, in the table or not, so that none of them is taken for a change.
"""

from __future__ import annotations

import numpy as np

from avtorch.arrays import FloatArray
from avtorch.gap.budget.analysis_record import AnalysisRecord
from avtorch.gap.likelihood.basis import lowpass

BASIC = 2
"""Columns that come first: a constant force, and a bias of the accelerometer.

GLVD is fitted with these alone, as no car rolls without resistance; the others stand for what it then leaves."""
_FAULTS = 7  # shapes that a fault of the accelerometer may follow alone


def columns(record: AnalysisRecord, rollout: FloatArray) -> FloatArray:
    """Columns (column, channel, row) along the acceleration `rollout` (row,) [m/s²] of the present model.

    A force shows in both channels, a fault of the accelerometer in its own alone. With one channel, the basic
    one is the first.
    """
    moving = record.speed[record.counts]
    speed = (record.speed - moving.mean()) / max(float(moving.std()), 0.1)
    forces = np.concatenate(
        [_forces(rollout[s.rows], speed[s.rows], record.command[s.rows], record.dt) for s in record.stretches], -1
    )
    if len(record.channels) == 1:
        return forces[:, None]
    both, faults = np.stack([forces, forces], 1), np.stack([np.zeros_like(forces), forces], 1)[:_FAULTS]
    return np.concatenate([both[: BASIC - 1], faults[:1], both[BASIC - 1 :], faults[1:]])


def _forces(a: FloatArray, speed: FloatArray, u: FloatArray, dt: float) -> FloatArray:
    v = lowpass(speed, 0.5, dt)
    jerk = np.gradient(a) / dt
    braking = np.minimum(a, 0.0)
    return np.array(
        [
            np.ones_like(a),
            v,
            v**2,
            a,
            jerk,
            a * v,
            braking,
            a * v**2,
            jerk * v,
            np.gradient(lowpass(jerk, 0.1, dt)) / dt,
            np.gradient(braking) / dt,
            np.tanh(a / 0.1),
            np.tanh(a / 0.3),
            np.tanh(jerk / 0.3),
            lowpass(np.tanh(np.gradient(u) / dt / 0.1), 0.3, dt),
            lowpass(u, 1.0, dt),
            lowpass(u, 3.0, dt),
        ]
    )
