"""What a recorder does to a signal, by its own law."""

from __future__ import annotations

import numpy as np
import pytest

from avtorch import Log
from avtorch.gap.engine.drive_data import DriveData
from tests.gap.engine.recorded import fitted_hypothesis, recorded_log


@pytest.mark.parametrize("time_constant", [0.02, 0.064, 0.3])
def test_a_ramp_passes_a_pole_exactly_at_any_rate(time_constant: float) -> None:
    data = fitted_hypothesis(recorded_log(rate_hz=20)).data
    t = data.time - data.time[0]
    expected = t - time_constant * (1 - np.exp(-t / time_constant))
    np.testing.assert_allclose(data.low_pass(t, time_constant), expected, atol=1e-9)


@pytest.mark.parametrize("time_constant", [0.02, 0.064, 0.3])
def test_it_does_though_rows_are_lost(time_constant: float, fresh_seed: int) -> None:
    log = recorded_log(rate_hz=20)
    kept = np.random.default_rng(fresh_seed).random(log.rows) > 0.05
    kept[:2] = True  # a first step that is the usual one
    assert log.accel_cmd is not None
    signals = {"accel_cmd": log.accel_cmd, "accel": log.accel, "speed": log.speed}
    rest = {name: x[kept] for name, x in signals.items() if x is not None}
    data = DriveData.of(Log.from_arrays(time=log.time[kept], **rest))
    assert data.gaps[0].max() > 0
    t = data.time - data.time[0]
    first = data.bounds[:-1]  # where many rows in a row are lost, another stretch begins, and with it the filter
    since = t - np.repeat(t[first], np.diff(data.bounds))
    expected = t - time_constant * (1 - np.exp(-since / time_constant))
    np.testing.assert_allclose(data.low_pass(t, time_constant), expected, atol=1e-9)


def test_what_explains_has_to_gain_below_half_of_what_rows_resolve() -> None:
    for rate_hz, claim_hz in ((10.0, 2.5), (20.0, 5.0), (100.0, 10.0)):
        assert fitted_hypothesis(recorded_log(rate_hz=rate_hz, seconds=30.0)).data.claim_hz == pytest.approx(claim_hz)


@pytest.mark.parametrize(("lost", "repeated"), [(0.0, 0.0), (0.02, 0.0), (0.02, 0.02)])
def test_a_held_speed_is_found_and_shown_though_rows_are_lost_or_repeated(lost: float, repeated: float) -> None:
    """The recorder renews a speed every fifth row by its clock, and then loses rows, those among them."""
    random = np.random.default_rng(5)
    time = 0.02 * np.arange(3000)
    course = 12.0 + 3.0 * np.sin(2 * np.pi * time / 17)
    speed = course[np.arange(3000) // 5 * 5]
    late = np.flatnonzero(random.random(3000) < repeated)
    speed[late] = speed[np.maximum(late - 1, 0)]
    kept = random.random(3000) >= lost
    kept[0] = True
    data = DriveData.of(
        Log.from_arrays(time=time[kept], accel_cmd=np.sin(time[kept]), accel=np.cos(time[kept]), speed=speed[kept])
    )
    assert data.hold == 5
    away = np.abs(data.held(course[kept]) - speed[kept])
    # between the neighbours of a row that was lost the course is straight to 1e-4; a repeated row is one row late
    assert np.quantile(away, 1.0 - repeated - 1e-9) < 1e-3
