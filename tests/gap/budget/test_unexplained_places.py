"""What no effect that was tried explains has a place where it has one, and the name of what it resembles."""

from __future__ import annotations

import pytest

from avtorch.gap import ConstantResistance, Effect, GainChange, SensorBias, gap_budget
from avtorch.gap.answer.budget import Unexplained
from avtorch.gap.answer.location import Location
from avtorch.gap.quantity import Quantity
from tests.gap.budget.cars import log_of

_CHANGES_S = 100.0


@pytest.mark.parametrize("effect", [SensorBias(0.2), pytest.param(ConstantResistance(0.2), marks=pytest.mark.slow)])
def test_what_was_not_tried_is_told_by_its_likeness(effect: Effect) -> None:
    rest = gap_budget(log_of([effect], seed=11), effects=["dead_time", "dead_band"]).unexplained
    assert rest.material
    assert rest.resembles == effect.name
    assert rest.where == ()  # it acts all the time


@pytest.mark.slow
def test_what_begins_late_has_its_place_in_time() -> None:
    rest = gap_budget(log_of([GainChange(0.6, _CHANGES_S)], seed=11), effects=["dead_time"]).unexplained
    assert rest.resembles == "gain_change"
    (part,) = rest.where
    assert part.axis == "time"
    assert isinstance(part.begin, float)
    assert isinstance(part.end, float)
    # the regression knows cubic courses of time: a step is spread over an eighth of the drive
    assert _CHANGES_S - 150.0 / 8 <= part.begin < part.end <= 150.0
    assert part.share > 0.7
    assert part.q_value <= 0.05
    assert rest.places() == f"from {part.begin:.1f} to {part.end:.1f} s after the log's start; most like gain_change"
    assert rest.to_dict()["where"][0]["axis"] == "time"


@pytest.mark.slow
def test_where_nothing_is_left_nothing_is_said() -> None:
    rest = gap_budget(log_of([ConstantResistance(0.2)], seed=11), effects=["constant_resistance"]).unexplained
    assert (rest.where, rest.resembles, rest.places()) == ((), None, "")


def test_times_are_told_from_the_logs_start() -> None:
    part = Location("time", 1010.0, 1020.0, 0.9, 0.01)
    rest = Unexplained(Quantity(0.2, 0.04, 0.12, 0.27), True, 0.99, (part,))
    assert rest.places(epoch_s=1000.0) == "from 10.0 to 20.0 s after the log's start"
