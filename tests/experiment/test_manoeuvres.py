"""Manoeuvres keep to their limits, come back to the speed they began at, and say what they are."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from avtorch.errors import InputError
from avtorch.experiment import Limits, library


@settings(deadline=None, max_examples=50)
@given(
    low=st.floats(0, 15),
    span=st.floats(5.1, 40),
    brake=st.floats(0.3, 6),
    push=st.floats(0.3, 4),
    road=st.floats(200, 4000),
    seconds=st.floats(20, 90),
)
def test_every_manoeuvre_keeps_to_the_limits(
    low: float, span: float, brake: float, push: float, road: float, seconds: float
) -> None:
    limits = Limits(low, low + span, -brake, push, road, seconds)
    offers = library(limits)
    assert len({m.name for m in offers}) == len(offers)
    for m in offers:
        assert low - 1e-6 <= m.speed.min()
        assert m.speed.max() <= low + span + 1e-6
        assert -brake - 1e-9 <= m.command.min()
        assert m.command.max() <= push + 1e-9
        assert np.trapezoid(m.speed, m.time) <= road
        assert m.time[-1] <= seconds + 1e-9
        # a perfect car does what is commanded, and ends as fast as it began
        np.testing.assert_allclose(m.speed, m.speed[0] + np.cumsum(np.r_[0, m.command[:-1] * np.diff(m.time)]))
        assert m.speed[-1] == pytest.approx(m.speed[0], abs=1e-6)
        assert not m.command[m.time < 3 - 1e-6].any()
        assert not m.command[m.time > m.time[-1] - 2 + 1e-6].any()


@settings(deadline=None, max_examples=25)
@given(seconds=st.floats(30, 90), brake=st.floats(1.5, 5), push=st.floats(1, 4))
def test_usual_limits_leave_manoeuvres_of_every_kind(seconds: float, brake: float, push: float) -> None:
    kinds = {m.name.split()[0] for m in library(Limits(accel_min=-brake, accel_max=push, seconds=seconds, road=3000))}
    assert {"steps", "pedals", "sweep", "small", "ramps"} <= kinds


def test_trimming_spreads_a_change_of_speed_over_gentle_commands() -> None:
    m = library()[0]
    trimmed = m.trimmed(2.0)
    assert trimmed.speed[-1] == pytest.approx(m.speed[-1] + 2.0)
    hard = (m.command == m.command.max()) | (m.command == m.command.min())
    np.testing.assert_array_equal(trimmed.command[hard], m.command[hard])


@pytest.mark.parametrize(
    ("name", "value", "needs"),
    [
        ("speed_max", 4.0, "5 m/s between"),
        ("speed_min", -1.0, "0 or more"),
        ("accel_min", 0.5, "-0.3 or less"),
        ("accel_max", float("nan"), "finite"),
        ("road", 10.0, "100 m"),
        ("seconds", 5.0, "20 s"),
    ],
)
def test_impossible_limits_are_named(name: str, value: float, needs: str) -> None:
    with pytest.raises(InputError, match=name) as told:
        Limits(**{name: value})
    assert needs in str(told.value)


def test_more_road_allows_more() -> None:
    rng = np.random.default_rng(0)
    for _ in range(5):
        short, long = sorted(rng.uniform(200, 3000, 2))
        assert {m.name for m in library(Limits(road=short))} <= {m.name for m in library(Limits(road=long))}
