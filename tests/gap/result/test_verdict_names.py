"""Which causes a verdict names, by the probabilities of their sets."""

from __future__ import annotations

import pytest

from avtorch.gap.engine.average import ModelAverage
from avtorch.gap.result.hypotheses import verdict_names


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
