"""Overrides carry no information about the car, to the bit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from avtorch.errors import InputError
from avtorch.gap import DeadTime, plant
from avtorch.gap.effects.speed_dependent_gain import SpeedDependentGain
from avtorch.gap.engine.coordinates import EFFECTS
from avtorch.gap.engine.drive_data import DriveData
from avtorch.gap.engine.hypothesis import Hypothesis
from avtorch.gap.result.counted_rows import CountedRows
from avtorch.gap.sensor_noise import with_sensor_noise
from avtorch.io import Log
from tests.gap.records import log_of
from tests.overridden import deleted

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
