"""The budget by families: what was put in front of a car is its family's, and an order of entry changes nothing."""

from __future__ import annotations

import pytest

from avtorch import diagnose
from avtorch.gap import BrakeThrottleAsymmetry, GainChange, SensorBias
from avtorch.gap.result.budget import Budget
from tests.gap.cars import log_of

BIAS = 0.3  # [m/s²]
FEW = ["dead_time", "brake_throttle_asymmetry", "sensor_bias", "gain_change", "gust"]


@pytest.fixture(scope="module")
def of_two() -> Budget:
    """Of a car whose brakes are weak and whose accelerometer is biased: two families."""
    log = log_of([BrakeThrottleAsymmetry(brake_gain_ratio=0.6, brake_lag_ratio=1.0), SensorBias(BIAS)], seed=3)
    budget = diagnose(log, effects=FEW).budget
    assert budget is not None
    return budget


def test_each_family_has_its_names_and_size(of_two: Budget) -> None:
    present = {family.family: family for family in of_two.families if family.present}
    assert {"force map", "sensor"} <= set(present)
    sensor = present["sensor"]
    assert sensor.names == ("sensor_bias",)
    assert sensor.size_mps2 is not None
    assert sensor.size_mps2.mean == pytest.approx(BIAS, rel=0.2)  # a constant: its root mean square is itself
    assert all(f.takes_off is not None and f.takes_off.mean > 0.1 for f in present.values() if f.family != "chance")


def test_what_is_absent_says_what_could_be_there(of_two: Budget) -> None:
    absent = {family.family: family for family in of_two.families if not family.present}
    time = absent["time"]
    assert time.size_mps2 is None
    assert time.takes_off is None
    # a change of the gain half way shows at a part of what the car does
    assert time.unseen_mps2 is not None
    assert 0 < time.unseen_mps2 < BIAS
    assert time.excited


@pytest.mark.slow
def test_what_was_put_in_is_no_longer_absent() -> None:
    budget = diagnose(log_of([GainChange(0.6, 60.0)], seed=4), effects=FEW).budget
    assert budget is not None
    first = budget.families[0]
    assert first.family == "time"
    assert first.present
    assert first.takes_off is not None
    assert first.takes_off.q05 > 0.5
