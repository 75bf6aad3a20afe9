"""What is named, by the probabilities of sets: verdicts, free forms, and what remains once the delay is in."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import pytest

from avtorch.gap import SensorBias, plant
from avtorch.gap.engine.average import ModelAverage
from avtorch.gap.engine.family import FORMS
from avtorch.gap.engine.roughness import SIGNS
from avtorch.gap.quantity import Quantity
from avtorch.gap.result.hypotheses import Candidate, given_dead_time, parts_of, said_of_unnamed, verdict_names
from tests.gap.verdicts import verdict_of


def names_of(**probabilities: float) -> set[str]:
    each = {label.replace("_and_", "+"): p for label, p in probabilities.items()}
    left = {"none": 0.0, "unknown": max(1.0 - sum(each.values()), 0.0)}
    ordered = dict(sorted((each | left).items(), key=lambda kv: -kv[1]))
    return set(verdict_names(ModelAverage(ordered, {}, ())))


@pytest.mark.parametrize(
    ("probabilities", "named"),
    [
        ({"dead_time": 0.9}, {"dead_time"}),
        ({"dead_time": 0.3}, {"unknown"}),
        # a half by itself, whatever is beside it
        ({"gust": 0.4, "dead_time_and_gust": 0.3, "gust_and_sensor_bias": 0.2}, {"gust"}),
        # each of two may stand in for the other: one of them is there, not both
        ({"dead_time_and_gust": 0.46, "gust_and_rate_limit": 0.44, "dead_time_and_gust_and_rate_limit": 0.08},
         {"dead_time", "gust"}),
        ({"dead_time_and_rate_limit": 0.7, "dead_time": 0.2}, {"dead_time", "rate_limit"}),
    ],
)  # fmt: skip
def test_a_verdict_names_what_is_likely_and_no_stand_in_beside_it(
    probabilities: dict[str, float], named: set[str]
) -> None:
    assert names_of(**probabilities) == named


def average(parts: dict[str, float]) -> ModelAverage:
    return ModelAverage({"none": 1.0}, {}, (), {}, parts)


def posterior() -> Any:
    plain = SimpleNamespace(force=None)
    return cast(Any, SimpleNamespace(weight=SimpleNamespace(examined=SimpleNamespace(hypothesis=plain))))


def test_free_forms_are_parts_the_likeliest_first() -> None:
    found = parts_of(average({"gain": 0.2, "delay": 0.7}), ("unknown",), posterior())
    assert [(p.name, p.form, p.family, p.probability) for p in found] == [
        (None, "delay", "time", 0.7),
        (None, "gain", "time", 0.2),
    ]
    assert "a delay that wanders" in said_of_unnamed(found)


def test_what_is_unlikely_is_not_said() -> None:
    assert said_of_unnamed(parts_of(average({"gain": 0.2}), ("none",), posterior())) == ""


def test_every_free_form_has_a_family() -> None:
    for form in ("linear", "sided", "cycle", "sensor", "map", "gain", "braking", "delay", *SIGNS):
        assert FORMS[form]


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
