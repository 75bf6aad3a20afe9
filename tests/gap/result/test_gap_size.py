"""How far the baseline is from a log: against the definitions, on rows made by hand."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
import torch

from avtorch.arrays import FloatArray
from avtorch.gap import DeadTime, Effect, SimulatorInput, plant
from avtorch.gap.result.counted_rows import BEGIN_S, HORIZON_S, CountedRows
from avtorch.gap.result.gap_size import Simulated, gap_size
from avtorch.io import Log
from avtorch.io.engagement import SETTLE_S
from tests.gap.records import BOTH, command_over

LAG, GAIN = 0.4, 0.9
ACCEL_SD, SPEED_SD = 0.05, 0.02


def drive(effects: Sequence[Effect] = (), *, rate_hz: int = 20, seconds: float = 32.0) -> tuple[Log, Simulated]:
    """A log with white noise, and the bare car under its commands, measured less simulated."""
    rng = np.random.default_rng(0)
    time = np.arange(round(seconds * rate_hz)) / rate_hz
    command = command_over(time)
    told = SimulatorInput(torch.as_tensor(time), torch.as_tensor(command), torch.full((len(time),), 18.0).double())
    car, bare = (plant(e, T_L=LAG, K_L=GAIN).response(told) for e in (effects, ()))
    accel = car.accel_measured.numpy() + ACCEL_SD * rng.standard_normal(len(time))
    speed = car.speed.numpy() + SPEED_SD * rng.standard_normal(len(time))
    log = Log.from_arrays(time=time, accel_cmd=command, accel=accel, speed=speed)
    rows = rows_of(log)
    errors = [rows.of_rows(accel - bare.accel_measured.numpy()), rows.of_rows(speed - bare.speed.numpy())]
    return log, Simulated(np.stack(errors), LAG)


def rows_of(log: Log, channels: Sequence[str] = BOTH) -> CountedRows:
    shown = {name: getattr(log, name) for name in channels}
    own = Log.from_arrays(time=log.time, accel_cmd=log.accel_cmd, **shown)
    return CountedRows.of(own)


@pytest.mark.parametrize("rate_hz", [20, 100])
def test_one_step_is_the_hold_from_the_measured_acceleration(rate_hz: int) -> None:
    log, none = drive(rate_hz=rate_hz)
    facts = gap_size(rows_of(log), none, none, detected=False)
    # Eq. 1 from each measured acceleration, its command held, at the log's own rate
    assert log.accel is not None
    assert log.accel_cmd is not None
    keep = np.exp(-1 / rate_hz / LAG)
    told = keep * log.accel[:-1] + (1 - keep) * GAIN * log.accel_cmd[:-1]
    first = round(SETTLE_S * rate_hz)
    want = np.sqrt(((log.accel[1:] - told)[first:] ** 2).mean())
    assert facts.one_step_rmse == pytest.approx(want, rel=1e-9)
    # both of the sensor's draws are in it: 600 rows or more, four standard errors of their size
    assert facts.one_step_rmse == pytest.approx(ACCEL_SD * np.sqrt(1 + keep**2), rel=0.15)
    assert facts.one_step_floor == facts.one_step_rmse


def test_free_runs_begin_anew_at_what_was_measured() -> None:
    log, none = drive()
    rows = rows_of(log)
    # a run that lags behind by 0.1 m/s every second: off by how long ago it began, which is any time up to 10 s
    errors: FloatArray = none.errors.copy()
    errors[-1] = 0.1 * rows.dt * np.arange(rows.rows)[:, None] + 7.0
    facts = gap_size(rows, Simulated(errors, LAG), none, detected=True)
    ages = rows.dt * (np.arange(rows.rows) % round(HORIZON_S / rows.dt))
    begun = ages[: round(BEGIN_S / rows.dt)].mean()  # from the mean over half a second on
    assert facts.rollout_rmse_speed == pytest.approx(np.sqrt(((0.1 * (ages - begun)) ** 2).mean()))
    # of a faster log the runs are as long
    quick = rows_of(drive(rate_hz=100)[0])
    errors = 0.1 * quick.dt * np.arange(quick.rows * quick.group).reshape(1, quick.rows, quick.group) / quick.group
    errors = np.concatenate([errors, errors])
    assert quick.rms(errors)["speed"] == pytest.approx(facts.rollout_rmse_speed, rel=0.01)
    assert facts.horizon_s == HORIZON_S == 10.0


def test_a_late_car_shows_and_its_floor_is_the_noise() -> None:
    log, none = drive([DeadTime(0.3)])
    best = drive()[1]  # the same noise, and nothing missing
    rows = rows_of(log)
    facts = gap_size(rows, none, best, detected=True)
    assert facts.rollout_rmse_accel is not None
    assert facts.rollout_rmse_accel > 0.2
    # 600 rows: within four standard errors of the sensor's noise
    assert facts.rollout_floor_accel == pytest.approx(ACCEL_SD, rel=4 / np.sqrt(2 * 560))
    # a favourite that leaves more than the baseline is no floor
    facts = gap_size(rows, best, none, detected=True)
    assert facts.rollout_floor_accel == facts.rollout_rmse_accel


def test_a_witness_that_is_missing_has_no_figure() -> None:
    log, none = drive(seconds=20.0)
    blind, deaf = (Simulated(none.errors[k : k + 1], LAG) for k in (1, 0))
    facts = gap_size(rows_of(log, ["speed"]), blind, blind, detected=False)
    assert (facts.one_step_rmse, facts.one_step_floor, facts.rollout_rmse_accel) == (None, None, None)
    assert facts.rollout_rmse_speed is not None
    assert gap_size(rows_of(log, ["accel"]), deaf, deaf, detected=False).rollout_rmse_speed is None
