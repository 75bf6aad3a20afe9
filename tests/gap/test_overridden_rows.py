"""Overrides carry no information about the car, to the bit, except the distance covered."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from avtorch.errors import InputError
from avtorch.gap import DeadTime, plant
from avtorch.gap.drive_record import Record
from avtorch.gap.effects import SpeedDependentGain
from avtorch.gap.engine.coordinates import EFFECTS
from avtorch.gap.engine.drive_data import DriveData
from avtorch.gap.engine.hypothesis import Hypothesis
from avtorch.gap.sensor_noise import with_sensor_noise
from avtorch.io import Log
from tests.gap.records import log_of
from tests.overridden import deleted

OVERRIDES = ((12.0, 15.0), (22.5, 22.6), (31.0, 36.2))


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
    """The road passes under the car during an override too: of its rows the measured speed counts."""
    rng = np.random.default_rng(seed)
    log = _driven(log_of(seconds=50.0, rate_hz=40, rng=rng))
    own, other = (Record.of(x) for x in (log, _garbled(log, ("accel_cmd", "accel"), rng)))
    np.testing.assert_array_equal(own.measured, other.measured)
    car = plant([SpeedDependentGain(0.3)])
    np.testing.assert_array_equal(*(r.rolled_out(car) for r in (own, other)))
    for one, two in zip(own.drives, other.drives, strict=True):
        assert one.position is not None
        assert two.position is not None
        np.testing.assert_array_equal(one.position.numpy(), two.position.numpy())


def test_drives_are_those_of_a_log_without_the_drivers_rows() -> None:
    log = _driven(log_of(seconds=50.0, rate_hz=40))
    own, other = (Record.of(x) for x in (log, deleted(log)))
    assert len(own.drives) == len(other.drives) == 4
    np.testing.assert_array_equal(own.source, other.source)
    np.testing.assert_array_equal(own.measured, other.measured)
    np.testing.assert_array_equal(*(r.rolled_out(plant([DeadTime(0.2)])) for r in (own, other)))


def test_the_road_runs_on_under_the_driver() -> None:
    log = _driven(log_of(seconds=50.0, rate_hz=40))
    assert log.speed is not None
    record = Record.of(log)
    travelled = np.concatenate([[0.0], np.cumsum(0.5 * (log.speed[1:] + log.speed[:-1]) * np.diff(log.time))])
    for drive, cut in zip(record.drives, record.cuts, strict=True):
        assert drive.position is not None
        # smoothed speeds and measured ones differ by the noise of 0.05 m/s and less
        np.testing.assert_allclose(drive.position.numpy(), travelled[cut.rows], atol=0.5)


def test_far_down_the_road_under_the_driver_lies_another_road() -> None:
    """An hour by hand is not rolled out, and its knots are not carried."""
    log = log_of(seconds=40.0)
    time = np.where(log.time < 20, log.time, log.time + 3600)
    taken = {n: getattr(log, n) for n in ("accel_cmd", "accel", "speed")}
    by_hand = 20 + np.arange(72_000) / 20
    at = int((log.time < 20).sum())
    columns = {n: np.insert(x, at, np.full(len(by_hand), 20.0 if n == "speed" else 0.0)) for n, x in taken.items()}
    engaged = np.insert(np.ones(log.rows), at, np.zeros(len(by_hand)))
    long = Log.from_arrays(name="drive", time=np.insert(time, at, by_hand), engaged=engaged, **columns)
    record = Record.of(long)
    assert [len(d.time) for d in record.drives] == [400, 400]
    first, second = (d.position for d in record.drives)
    assert first is not None
    assert second is not None
    assert float(second[0] - first[-1]) == pytest.approx(1000.0)


@pytest.mark.parametrize("driven", [slice(None), slice(0, None, 2)], ids=["all by hand", "every other row"])
def test_where_nothing_is_left_the_error_names_it(driven: slice) -> None:
    log = log_of(seconds=30.0)
    engaged = np.ones(log.rows, bool)
    engaged[driven] = False
    with pytest.raises(InputError) as told:
        Record.of(replace(log, engaged=engaged))
    assert str(told.value).startswith("drive: 0.0 s of usable driving")
    if not engaged.any():
        assert "return" not in str(told.value)
    else:
        assert "each of 300 returns to engaged" in str(told.value)
