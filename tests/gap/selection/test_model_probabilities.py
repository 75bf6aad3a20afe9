"""From evidence to probabilities."""

from __future__ import annotations

from typing import Any, cast

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from avtorch.errors import InputError
from avtorch.gap.search.fitted_model import FittedModel
from avtorch.gap.selection import model_probabilities as odds
from avtorch.gap.selection.adequacy import Adequacy
from avtorch.gap.selection.calibration import CALIBRATION

NOTHING = Adequacy(-1.0, -1.0, -1.0, -1.0, -1.0, 0.0)


def race(**nats: float) -> list[FittedModel]:
    """Candidates with this much log evidence; `a__b` is a pair."""
    made: list[Any] = []
    for name, evidence in nats.items():
        found = object.__new__(FittedModel)
        object.__setattr__(found, "name", "+".join(sorted(name.split("__"))))
        object.__setattr__(found, "log_evidence", evidence)
        made.append(found)
    return cast(list[FittedModel], made)


nats = st.floats(-200, 1e5)


@given(dead_time=nats, gust=nats, pair=nats, left=st.floats(-5, 1e5))
def test_they_sum_to_one(dead_time: float, gust: float, pair: float, left: float) -> None:
    found = race(none=-30.0, dead_time=dead_time, gust=gust, dead_time__gust=pair)
    told = odds.model_probabilities(found, Adequacy(left, 0.0, 0.0, 0.0, 0.0, 0.0))
    assert set(told) == {"none", "dead_time", "gust", "dead_time+gust", "unknown"}
    assert all(0 <= p <= 1 for p in told.values())
    assert sum(told.values()) == pytest.approx(1, abs=1e-12)


@given(dead_time=nats, shift=st.floats(-1e4, 1e4))
@example(dead_time=CALIBRATION.odds.effect, shift=1.0)  # as probable as none but for round-off, on either side of it
def test_only_differences_of_evidence_count(dead_time: float, shift: float) -> None:
    there = odds.model_probabilities(race(none=0.0, dead_time=dead_time), NOTHING)
    moved = odds.model_probabilities(race(none=shift, dead_time=dead_time + shift), NOTHING)
    assert moved == pytest.approx(there, abs=1e-6)


@pytest.mark.parametrize("gain", [2.0, 40.0, 3000.0])
def test_more_evidence_is_more_probable(gain: float) -> None:
    weak = odds.model_probabilities(race(none=0.0, dead_time=gain), NOTHING)
    strong = odds.model_probabilities(race(none=0.0, dead_time=2 * gain), NOTHING)
    assert strong["dead_time"] > weak["dead_time"]
    assert strong["none"] < weak["none"]


def test_equal_evidence_goes_to_the_plainer_answer() -> None:
    told = odds.model_probabilities(race(none=0.0, dead_time=0.0, gust=0.0, dead_time__backlash=0.0), NOTHING)
    assert told["none"] > told["dead_time"] > told["backlash+dead_time"]


def test_a_second_effect_pays_more_where_the_first_gains_more() -> None:
    """A hair of misfit in the equations of a strong effect is many nats."""
    faint = odds.model_probabilities(race(none=0.0, dead_time=50.0, dead_time__backlash=80.0), NOTHING)
    strong = odds.model_probabilities(race(none=0.0, dead_time=50000.0, dead_time__backlash=50030.0), NOTHING)
    assert faint["backlash+dead_time"] / faint["dead_time"] > strong["backlash+dead_time"] / strong["dead_time"]


def test_what_is_left_over_speaks_for_unknown() -> None:
    found = race(none=0.0, dead_time=60.0)
    told = [odds.model_probabilities(found, Adequacy(x, 0, 0, 0, 0, 0))["unknown"] for x in (0.0, 5.0, 50.0, 500.0)]
    assert np.all(np.diff(told) > 0)
    assert told[-1] > 0.5 > told[0]
    # the same structure is little beside an effect of ten thousand nats
    beside = odds.model_probabilities(race(none=0.0, dead_time=10000.0), Adequacy(50.0, 0, 0, 0, 0, 0))
    assert beside["unknown"] < told[2]


def test_the_users_prior_multiplies() -> None:
    found = race(none=0.0, dead_time=20.0, dead_time__backlash=30.0)
    plain = odds.model_probabilities(found, NOTHING)
    told = odds.model_probabilities(found, NOTHING, {"dead_time": 3.0})
    for name, factor in (("dead_time", 3.0), ("backlash+dead_time", 3.0)):
        assert told[name] / told["none"] == pytest.approx(factor * plain[name] / plain["none"])
    pairs = odds.model_probabilities(found, NOTHING, {"pair": 0.0})
    assert pairs["backlash+dead_time"] == 0
    assert odds.model_probabilities(found, NOTHING, {"unknown": 0.0})["unknown"] == 0
    only = odds.model_probabilities(found, NOTHING, {"none": 0.0, "dead_time": 0.0})
    assert only["unknown"] == 1


@pytest.mark.parametrize("weight", [-1.0, float("nan"), float("inf")])
def test_a_weight_that_is_none_is_refused(weight: float) -> None:
    with pytest.raises(InputError, match="prior: found dead_time"):
        odds.model_probabilities(race(none=0.0, dead_time=20.0), NOTHING, {"dead_time": weight})
    with pytest.raises(InputError, match="needs one above 0"):
        odds.model_probabilities(race(none=0.0), NOTHING, {"none": 0.0, "unknown": 0.0})
