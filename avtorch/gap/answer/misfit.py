"""How far the fitted baseline is from the log, in one step and over seconds, and what the best candidate leaves."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from avtorch.gap.answer.diagnosis import GapFacts
from avtorch.gap.answer.repeats import repeats
from avtorch.gap.likelihood.record import Record
from avtorch.gap.search.found import Found, Race

Float = NDArray[np.float64]

HORIZON_S = 5.0
"""Seconds over which a rollout goes before it begins anew at the measured speed."""


def gap_facts(race: Race, best: Found, *, detected: bool, p_value: float | None = None) -> GapFacts:
    """Root mean square errors of `race.none`, the fitted baseline, and as their floors those of `best` if smaller.

    (An effect may help the speed and cost the acceleration something, and the best of wrong ones may well.)
    Rollouts of the acceleration are the whole drive's, which after some lags no longer know where they began; those of
    the speed begin anew at the measured one every `HORIZON_S`. None where the log lacks the witness, and for the speed
    where no stretch lasts that long.
    """
    none, record = race.none, race.record
    one, rollout = [], []
    for f in (none, best):
        if record.accel is not None:
            one.append(_one_step(record, f.errors[0], f.values["T_L"]))
            rollout.append(_size(f.errors[0]))
    return GapFacts(
        detected=detected,
        p_value=p_value,
        one_step_rmse=one[0] if one else None,
        one_step_floor=min(one, default=None),
        rollout_rmse_accel=rollout[0] if rollout else None,
        rollout_floor_accel=min(rollout, default=None),
        rollout_rmse_speed=None if record.speed is None else _anew(record, none.errors[-1].mean(-1)),
        horizon_s=HORIZON_S,
        repeats=repeats(record),
    )


def _one_step(record: Record, errors: Float, lag: float) -> float:
    """Of the acceleration foretold for a row from the one measured a row before.

    An error of the rollout dies away with the lag, so the error of one step is `e[k+1] - exp(-dt / T_L) e[k]`: of GLVD
    exactly what its zero-order hold from the measured acceleration leaves.
    """
    keep = float(np.exp(-record.dt / record.group / lag))
    steps = [x[1:] - keep * x[:-1] for x in map(np.ravel, _stretches(record, errors))]
    return _size(np.concatenate(steps))


def _anew(record: Record, errors: Float) -> float | None:
    """Of the speed, `errors` (counted,) of the whole drive's rollout begun anew every horizon."""
    rows = round(HORIZON_S / record.dt)
    parts = []
    for x in _stretches(record, errors):
        whole = len(x) // rows
        blocks = x[: whole * rows].reshape(whole, rows)
        parts.append((blocks - blocks[:, :1])[:, 1:].ravel())
    joined = np.concatenate(parts)
    return _size(joined) if len(joined) else None


def _stretches(record: Record, values: Float) -> list[Float]:
    """`values` (counted, ...) of each stretch without gaps."""
    return np.split(values, record.starts[1:])


def _size(x: Float) -> float:
    return float(np.sqrt((x**2).mean()))
