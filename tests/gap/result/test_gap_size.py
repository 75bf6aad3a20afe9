"""How far the baseline is from a log: against the definitions, on rows made by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from avtorch.gap import DeadTime
from avtorch.gap.likelihood.noise_model import NoiseModel
from avtorch.gap.result.gap_size import gap_size
from avtorch.gap.rollout_errors import HORIZON_S
from avtorch.gap.search.fitted_model import FittedModel, SearchResult
from tests.gap.finds import found_of

STILL = NoiseModel(process_sd=1e-6, force_sd=1e-6, accel_sd=0.05, speed_sd=0.02)


def race_of(none: FittedModel, *others: FittedModel) -> SearchResult:
    record = none.hypothesis.record
    return SearchResult(record, record, (), (none, *others), complete=True)


@pytest.mark.parametrize("rate_hz", [20, 100])
def test_one_step_is_the_hold_from_the_measured_acceleration(rate_hz: int) -> None:
    none = found_of([], rate_hz=rate_hz, noise=STILL, seconds=20.0)
    record = none.hypothesis.record
    assert record.accel is not None
    facts = gap_size(race_of(none), none, detected=False)
    # Eq. 1 from each measured acceleration, its command held, at the log's own rate
    drive, T, K = record.drives[0], none.values["T_L"], none.values["K_L"]
    measured = record.accel.ravel()
    keep = np.exp(-1 / rate_hz / T)
    told = keep * measured[:-1] + (1 - keep) * K * drive.command.numpy()[:-1]
    first = record.source[0] * record.group
    want = np.sqrt(((measured[1:] - told)[first:] ** 2).mean())
    assert facts.one_step_rmse == pytest.approx(want, rel=1e-9)
    # both of the sensor's draws are in it
    assert facts.one_step_rmse == pytest.approx(0.05 * np.sqrt(1 + keep**2), rel=0.15)
    assert facts.one_step_floor == facts.one_step_rmse


def test_rollouts_begin_anew_at_every_row() -> None:
    none = found_of([], noise=STILL, seconds=22.0)
    rows = none.hypothesis.record.rows
    dt = none.hypothesis.record.dt
    # a rollout that lags behind by 0.1 m/s every second: off by how long ago it began, which is any time up to 10 s
    errors = none.errors.copy()
    errors[-1] = 0.1 * dt * np.arange(rows)[:, None] + 7.0
    facts = gap_size(race_of(replace(none, errors=errors)), none, detected=True)
    ages = [dt * np.arange(min(k + 1, round(HORIZON_S / dt))) for k in range(rows)]
    want = np.mean([((0.1 * age) ** 2).mean() for age in ages])
    assert facts.rollout_rmse_speed == pytest.approx(np.sqrt(want))
    assert facts.horizon_s == HORIZON_S == 10.0


def test_a_short_stretch_is_its_own_horizon() -> None:
    none = found_of([], noise=STILL, seconds=22.0)
    record = none.hypothesis.record
    halves = replace(record, stretch=(np.arange(record.rows) >= 160).astype(record.stretch.dtype) + record.stretch)
    cut = replace(none, hypothesis=replace(none.hypothesis, record=halves.only(np.arange(record.rows) < 160)))
    cut = replace(cut, errors=none.errors[:, :160])
    facts = gap_size(race_of(cut), cut, detected=True)
    assert facts.horizon_s == pytest.approx(160 * record.dt)


def test_a_late_car_shows_and_its_floor_is_the_noise() -> None:
    late = found_of([DeadTime(0.3)], noise=STILL)
    candidate = replace(late.hypothesis, effects=())
    z = late.z[:2]
    none = replace(late, name="none", hypothesis=candidate, z=z, errors=candidate.errors(z[None])[0])
    facts = gap_size(race_of(none, late), late, detected=True)
    assert facts.rollout_rmse_accel is not None
    assert facts.rollout_rmse_accel > 0.2
    # 600 rows: within four standard errors of the sensor's noise
    assert facts.rollout_floor_accel == pytest.approx(0.05, rel=4 / np.sqrt(2 * 560))
    # a favourite that leaves more than the baseline is no floor
    turned = SearchResult(candidate.record, candidate.record, (), (replace(late, name="none"), none), complete=True)
    facts = gap_size(turned, none, detected=True)
    assert facts.rollout_floor_accel == facts.rollout_rmse_accel


def test_a_witness_that_is_missing_has_no_figure() -> None:
    none = found_of([], noise=STILL, seconds=20.0)
    record = none.hypothesis.record
    blind = replace(record, accel=None)
    found = replace(none, hypothesis=replace(none.hypothesis, record=blind), errors=none.errors[-1:])
    facts = gap_size(race_of(found), found, detected=False)
    assert (facts.one_step_rmse, facts.one_step_floor, facts.rollout_rmse_accel) == (None, None, None)
    assert facts.rollout_rmse_speed is not None
    deaf = replace(
        none, hypothesis=replace(none.hypothesis, record=replace(record, speed=None)), errors=none.errors[:1]
    )
    assert gap_size(race_of(deaf), deaf, detected=False).rollout_rmse_speed is None
