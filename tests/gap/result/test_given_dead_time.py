"""What remains once the delay is in: the candidates that contain it, among themselves."""

from __future__ import annotations

import pytest

from avtorch.gap import SensorBias, plant
from avtorch.gap.quantity import Quantity
from avtorch.gap.result.hypotheses import Candidate, given_dead_time
from tests.gap.verdicts import verdict_of

HALF = Quantity(0.1, 0.01, 0.08, 0.12)
RACE = (
    Candidate("dead_time", 0.40, 900.0, {"delay_s": HALF}),
    Candidate(
        "aerodynamic_drag+dead_time", 0.15, 930.0, {"aerodynamic_drag.drag_per_m": HALF, "dead_time.delay_s": HALF}
    ),
    Candidate("dead_time+gust", 0.05, 890.0, {"dead_time.delay_s": HALF, "gust.sd_mps2": HALF}),
    Candidate("second_order_actuator", 0.2, 880.0),
    Candidate("none", 0.0, 0.0),
    Candidate("unknown", 0.2),
)


def test_the_pairs_with_the_delay_relative_to_it_alone() -> None:
    left = given_dead_time(RACE, verdict_of(RACE), plant())
    assert left is not None
    assert [c.name for c in left] == ["none", "unknown", "aerodynamic_drag", "gust"]
    assert sum(c.probability for c in left) == pytest.approx(1.0)
    by_name = {c.name: c for c in left}
    # 0.40, 0.15 and 0.05 of the 0.8 that unknown leaves
    assert by_name["none"].probability == pytest.approx(0.8 * 0.4 / 0.6)
    assert by_name["gust"].probability == pytest.approx(0.8 * 0.05 / 0.6)
    assert by_name["unknown"].probability == 0.2
    assert {n: c.log_evidence for n, c in by_name.items()} == {
        "none": 0.0,
        "aerodynamic_drag": 30.0,
        "gust": -10.0,
        "unknown": None,
    }
    assert by_name["aerodynamic_drag"].parameters == {"drag_per_m": HALF}
    assert not by_name["none"].parameters


def test_a_verdict_of_the_delay_and_something_else() -> None:
    pair = tuple(Candidate(c.name, {"aerodynamic_drag+dead_time": 0.5}.get(c.name, 0.1), c.log_evidence) for c in RACE)
    left = given_dead_time(pair, verdict_of(pair))
    assert left is not None
    assert left[0].name == "aerodynamic_drag"


def test_nothing_where_it_would_be_no_news() -> None:
    verdict = verdict_of(RACE)
    assert given_dead_time(RACE, verdict, plant([SensorBias()])) is None
    assert given_dead_time([c for c in RACE if "+" not in c.name], verdict) is None
    other = tuple(Candidate(c.name, 0.9 if c.name == "second_order_actuator" else 0.02, c.log_evidence) for c in RACE)
    assert given_dead_time(other, verdict_of(other)) is None
