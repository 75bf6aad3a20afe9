"""A driver who acts against the command now and then: his rows carry no information about the car, to the bit."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import avtorch
from avtorch.errors import InputError
from avtorch.gap import DeadTime, plant
from avtorch.gap.effects.speed_dependent_gain import SpeedDependentGain
from avtorch.gap.engine.coordinates import EFFECTS
from avtorch.gap.engine.drive_data import DriveData
from avtorch.gap.engine.hypothesis import Hypothesis
from avtorch.gap.result.counted_rows import CountedRows
from avtorch.gap.sensor_noise import with_sensor_noise
from avtorch.io import Log
from tests.bars import BAR, student
from tests.gap.records import log_of
from tests.overridden import deleted, taken_over

OVERRIDES = ((14.0, 17.0), (22.5, 22.6), (31.0, 36.2))


def _driven(log: Log) -> Log:
    taken = np.zeros(log.rows, bool)
    for begin, end in OVERRIDES:
        taken |= (log.time >= begin) & (log.time < end)
    return replace(log, engaged=~taken)


def _garbled(log: Log, names: tuple[str, ...], rng: np.random.Generator) -> Log:
    """Other finite values of these signals wherever the driver is in charge."""
    changed = {}
    for name in names:
        x = getattr(log, name).copy()
        x[~log.engaged] = rng.uniform(0.0, 40.0, (~log.engaged).sum()) - (0.0 if name == "speed" else 20.0)
        changed[name] = x
    return replace(log, **changed)


@pytest.mark.parametrize(
    ("effects", "channels"),
    [
        ((), ("accel", "speed")),
        (("brake_throttle_asymmetry", "dead_time"), ("accel", "speed")),
        (("speed_dependent_gain",), ("accel", "speed")),
        (("dead_time",), ("accel",)),
        (("dead_time",), ("speed",)),
    ],
)
@given(seed=st.integers(0, 2**31))
@settings(max_examples=4, deadline=None)
def test_a_drivers_rows_change_no_likelihood(effects: tuple[str, ...], channels: tuple[str, ...], seed: int) -> None:
    rng = np.random.default_rng(seed)
    log = _driven(log_of(seconds=60.0, rate_hz=40, rng=rng, channels=channels))
    told = []
    for one in (log, _garbled(log, ("accel_cmd", *channels), rng)):
        h = Hypothesis(DriveData.of(with_sensor_noise(one)[0]))
        for effect in effects:
            h = h.with_effect(effect, EFFECTS[effect].starts[-1])
        h.evaluate()
        told.append((h.data.measured, h.data.position, h.predicted, h.log_likelihood))
    for one, other in zip(*told, strict=True):
        np.testing.assert_array_equal(one, other)


@given(seed=st.integers(0, 2**31))
@settings(max_examples=4, deadline=None)
def test_a_drivers_rows_change_no_rollout(seed: int) -> None:
    rng = np.random.default_rng(seed)
    log = _driven(log_of(seconds=60.0, rate_hz=40, rng=rng))
    own, other = (CountedRows.of(x) for x in (log, _garbled(log, ("accel_cmd", "accel", "speed"), rng)))
    np.testing.assert_array_equal(own.measured, other.measured)
    car = plant([SpeedDependentGain(0.3)])
    np.testing.assert_array_equal(*(r.rolled_out(car) for r in (own, other)))


def test_drives_are_those_of_a_log_without_the_drivers_rows() -> None:
    log = _driven(log_of(seconds=60.0, rate_hz=40))
    own, other = (CountedRows.of(x) for x in (log, deleted(log)))
    assert len(own.drives) == len(other.drives) == 2
    np.testing.assert_array_equal(own.measured, other.measured)
    np.testing.assert_allclose(*(r.rolled_out(plant([DeadTime(0.2)])) for r in (own, other)), atol=1e-9)


@pytest.mark.parametrize("driven", [slice(None), slice(0, None, 2)], ids=["all by hand", "every other row"])
def test_where_nothing_is_left_the_error_names_it(driven: slice) -> None:
    log = log_of(seconds=30.0)
    engaged = np.ones(log.rows, bool)
    engaged[driven] = False
    with pytest.raises(
        InputError, match=r"drive: 0\.\d s of driving in one stretch \(moving, engaged\), needs 12 s or more"
    ):
        CountedRows.of(replace(log, engaged=engaged))


CANDIDATES = ["brake_throttle_asymmetry", "dead_time", "road_grade"]
RATIO, DELAY = 0.70, 0.15
TAKEN_OVER = ((20.0, 26.0), (44.0, 49.0))


@pytest.mark.slow
@pytest.mark.statistical
def test_a_weak_brake_and_a_delay_are_found_although_a_driver_took_over(rotating_seed: int) -> None:
    """Rolled out through, they came out as unknown and as a hill that begins where the driver let go."""
    rng = np.random.default_rng(rotating_seed)
    log = taken_over(seconds=72.0, overrides=TAKEN_OVER, rng=rng, brake_gain_ratio=RATIO, delay_s=DELAY)
    found = avtorch.diagnose(log, effects=CANDIDATES)
    assert found.verdict.name == "brake_throttle_asymmetry+dead_time"
    assert found.onset_s is None
    one = next(c for c in found.candidates if c.name == found.verdict.name)
    assert one.probability > 0.5
    ratio, delay = (one.parameters[name] for name in ("brake_throttle_asymmetry.brake_gain_ratio", "dead_time.delay_s"))
    # five of its own standard deviations; the loop around the speed adds a millisecond
    assert ratio.mean == pytest.approx(RATIO, abs=BAR * ratio.sd)
    assert delay.mean == pytest.approx(DELAY, abs=BAR * delay.sd + 0.001)
    assert delay.sd < 0.0125  # that of a recorder's delay, of which it cannot be told: 7.5 and 10 ms
    # a drive with overrides is one drive: blocks of it are held out, not the parts between overrides
    assert found.log.segments == 1
    assert found.shrinkage is not None
    assert not found.shrinkage.by_drives
    # the traces hold the rows that count, and no rollout came through an override
    assert found.traces is not None
    time = found.traces.time
    assert not any(((time >= begin) & (time < end + 1.99)).any() for begin, end in TAKEN_OVER)
    assert np.abs(found.traces.measured[0] - found.traces.after[0]).max() < 0.3


@pytest.mark.slow
def test_a_log_without_the_drivers_rows_gives_the_same_answer(fresh_seed: int) -> None:
    rng = np.random.default_rng(fresh_seed)
    log = taken_over(seconds=60.0, overrides=TAKEN_OVER, rng=rng, brake_gain_ratio=RATIO, delay_s=DELAY)
    one, two = (avtorch.diagnose(x, effects=CANDIDATES).candidates[0] for x in (log, deleted(log)))
    assert one.name == two.name == "brake_throttle_asymmetry+dead_time"
    # the same rows, rolled out from the same places; only the roads of other candidates end at a gap
    assert one.probability == pytest.approx(two.probability, abs=1e-3)
    for name, quantity in two.parameters.items():
        assert one.parameters[name].mean == pytest.approx(quantity.mean, abs=1e-6)


@pytest.mark.slow
@pytest.mark.statistical
def test_a_car_is_the_same_under_a_driver_who_takes_over(rotating_seed: int) -> None:
    rng = np.random.default_rng(rotating_seed)
    drive = partial(taken_over, rng=rng, T_L=0.4, K_L=0.9, delay_s=0.1)
    before = drive(seconds=102.0, overrides=())  # ten blocks of 10 s, behind two in which the drive settles
    overrides = [(18.0 + 20 * k, 20.0 + 20 * k) for k in range(5)]  # stretches of 12 s or more are compared
    after = drive(seconds=100.0, overrides=overrides)
    told = avtorch.compare(before, after)
    # less by chance in one of ten thousand
    assert told.p_value > 1e-4
    for name in ("T_L", "K_L"):
        ratio = told.car[name].ratio
        assert abs(np.log(ratio.mean)) < student(9) * ratio.sd / ratio.mean
        # ten blocks before and eleven after tell it to a few percent; rolled out through overrides the lag went from
        # 0.5 to 2 s, +- 3
        assert ratio.sd < 0.1
    # nor is the simulator farther from this car, whose errors are mostly the sensors' noise
    assert told.gap["rollout_rmse_accel"].ratio.mean == pytest.approx(1.0, abs=0.3)
