"""Size of the gap: errors of the fitted baseline in one step and over seconds, and those of the best hypothesis."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from avtorch.arrays import FloatArray
from avtorch.gap.counted import Counted
from avtorch.gap.result.repeatability import Repeatability, repeatability
from avtorch.gap.rollout_errors import HORIZON_S, RolloutMetric, reached, rms


class Simulated(NamedTuple):
    """A simulator's `errors` (channel, row, group), measured less simulated, and its `lag` [s]."""

    errors: FloatArray
    lag: float


@dataclass(frozen=True)
class GapSize:
    """Errors of the baseline, and those of the best hypothesis as `floor`; None where not measured.

    Rollouts last `horizon_s` [s]; accelerations [m/s²], speed [m/s]. `detected`: there is a gap, with p-value
    `p_value`. `repeats`: the noise floor estimated from repeated commands, None where there are none.
    """

    detected: bool
    p_value: float | None = None
    one_step_rmse: float | None = None
    one_step_floor: float | None = None
    rollout_rmse_accel: float | None = None
    rollout_floor_accel: float | None = None
    rollout_rmse_speed: float | None = None
    horizon_s: float | None = None
    repeats: Repeatability | None = None

    def to_dict(self) -> dict[str, Any]:
        return {
            "one_step": {"rmse": self.one_step_rmse, "floor": self.one_step_floor},
            "rollout": {
                "rmse_accel": self.rollout_rmse_accel,
                "floor_accel": self.rollout_floor_accel,
                "rmse_speed": self.rollout_rmse_speed,
                "horizon_s": self.horizon_s,
            },
            "detected": bool(self.detected),
            "p_value": self.p_value,
            "repeats": None if self.repeats is None else self.repeats.to_dict(),
        }


def gap_size(
    rows: Counted,
    none: Simulated,
    best: Simulated,
    *,
    detected: bool,
    p_value: float | None = None,
) -> GapSize:
    """Root mean square errors of `none`, the fitted baseline, with those of `best` as floors where smaller.

    (An effect may improve the speed at the cost of the acceleration, and a wrong one often does.) Rollouts start from
    the measurement at every row, and last `HORIZON_S` or as long as the longest stretch: the measures are those of
    `shrinkage`, here over all counted rows. None where the log lacks the channel.
    """
    one: list[float] = []
    if rows.accel is not None:
        one = [_one_step(rows, x.errors[0], x.lag) for x in (none, best)]
    usual = {name: RolloutMetric(name, HORIZON_S) for name in rows.channels}
    rollout = {name: [rms(m, rows, x.errors, none.lag) for x in (none, best)] for name, m in usual.items()}
    accel, speed = (rollout.get(name, []) for name in ("accel", "speed"))
    return GapSize(
        detected=detected,
        p_value=p_value,
        one_step_rmse=one[0] if one else None,
        one_step_floor=min(one, default=None),
        rollout_rmse_accel=accel[0] if accel else None,
        rollout_floor_accel=min(accel, default=None),
        rollout_rmse_speed=speed[0] if speed else None,
        horizon_s=reached(usual[rows.channels[0]], rows),
        repeats=repeatability(rows),
    )


def _one_step(record: Counted, errors: FloatArray, lag: float) -> float:
    """RMS error of the acceleration predicted for a row from the measurement one row earlier.

    A rollout error decays with the lag, so the one-step error is `e[k+1] - exp(-dt / T_L) e[k]`: for GLVD exactly the
    error of its zero-order hold from the measured acceleration.
    """
    keep = float(np.exp(-record.dt / record.group / lag))
    steps = [x[1:] - keep * x[:-1] for x in map(np.ravel, _stretches(record, errors))]
    return _size(np.concatenate(steps))


def _stretches(record: Counted, values: FloatArray) -> list[FloatArray]:
    """`values` (counted, ...) of each stretch without gaps."""
    return np.split(values, record.starts[1:])


def _size(x: FloatArray) -> float:
    return float(np.sqrt((x**2).mean()))
