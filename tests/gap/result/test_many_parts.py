"""An answer holds any number of parts, and names each of them; what the error that is left is said to be."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from avtorch.gap import EFFECTS
from avtorch.gap.quantity import Quantity
from avtorch.gap.result.budget import Budget, ChancePart, ChannelError, Part, Unexplained
from avtorch.gap.result.diagnosis import Diagnosis
from avtorch.gap.result.gap_size import GapSize
from avtorch.gap.result.hypotheses import Candidate, Verdict, candidate_name
from avtorch.gap.result.log_facts import LogFacts
from avtorch.gap.result.sentences import headline

NAMES = (
    "sensor_lag",
    "constant_resistance",
    "speed_dependent_gain",
    "dead_time",
    "aerodynamic_drag",
    "brake_throttle_asymmetry",
    "sensor_bias",
)
"""Seven, the largest share first."""
SHARES = (0.3, 0.2, 0.15, 0.12, 0.1, 0.06, 0.04)


def about(mean: float) -> Quantity:
    return Quantity(mean, 0.1 * mean, 0.85 * mean, 1.15 * mean)


@pytest.fixture
def seven() -> Diagnosis:
    parts = []
    for count, (name, share) in enumerate(zip(NAMES, SHARES, strict=True), start=1):
        values = {key: about(float(value)) for key, value in EFFECTS[name]().values().items()}
        parts.append(Part(name, (name,), 0.98 - 0.05 * count, about(share), 6.0 - 0.6 * count, values))
    budget = Budget(
        before=6.0,
        left=1.8,
        by_channel={"speed": ChannelError(0.6, 0.1, 0.18)},
        parts=tuple(parts),
        unexplained=Unexplained(about(1 - sum(SHARES)), material=False, probability=0.2),
        repaired={"T_L": about(0.4), "K_L": about(0.9)},
    )
    named = {f"{part.name}.{key}": q for part in parts for key, q in part.parameters.items()}
    candidates = (
        Candidate(candidate_name(NAMES), 0.7, 1900.0, named),
        Candidate("dead_time", 0.08, 900.0),
        Candidate("none", 0.02, 0.0),
        Candidate("unknown", 0.2),
    )
    log = LogFacts(rows=6000, segments=1, seconds=300.0, rate_hz=20.0, signals=("accel_cmd", "accel", "speed"))
    verdict = Verdict(budget.verdict, (candidate_name(NAMES),), abstained=False, why="They predict.")
    return Diagnosis(log, {}, GapSize(True), candidates, verdict, budget=budget)


def test_the_answer_names_all_seven(seven: Diagnosis, tmp_path: Path) -> None:
    seven.write(tmp_path)
    answer = json.loads((tmp_path / "diagnosis.json").read_text(encoding="utf-8"))
    assert answer["schema"] == "avtorch.diagnosis/2"
    assert tuple(answer["verdict"]["names"]) == NAMES
    assert [part["names"] for part in answer["budget"]["parts"]] == [[name] for name in NAMES]
    shares = [part["share"]["mean"] for part in answer["budget"]["parts"]]
    assert shares == sorted(shares, reverse=True)
    assert sum(shares) + answer["budget"]["unexplained"]["share"]["mean"] == pytest.approx(1.0)


def test_they_are_one_hypothesis_among_the_others(seven: Diagnosis) -> None:
    effects = seven.to_dict()["effects"]
    (whole,) = (e for e in effects if e["name"] == "+".join(sorted(NAMES)))
    assert {key.partition(".")[0] for key in whole["parameters"]} == set(NAMES)
    assert sum(e["probability"] for e in effects) == pytest.approx(1.0)


def test_the_sentence_says_what_each_does(seven: Diagnosis) -> None:
    told = " ".join(str(seven).split())
    assert all(name in told for name in NAMES)


def test_causes_by_chance_alone_are_named_by_the_headline(seven: Diagnosis) -> None:
    assert seven.budget is not None
    budget = replace(seven.budget, parts=(), chance=(ChancePart("gust", 0.9), ChancePart("outliers", 0.8)))
    verdict = Verdict(budget.verdict, ("gust+outliers",), abstained=False, why="They predict.")
    said = headline(replace(seven, budget=budget, verdict=verdict))
    assert all(name in said for name in ("gust", "outliers"))


def rest(q05: float, q95: float) -> str:
    share = Quantity(0.0, 0.0, 0.0, 0.0)
    return Unexplained(share, material=False, still=Quantity(q05, 0.0, q05, q95)).rest(0.03)


def test_it_is_noise_only_where_no_black_box_could_take_off_what_matters() -> None:
    assert rest(0.0, 0.02) == "noise"
    assert rest(0.12, 0.3) == "noise but for 12 to 30 %, which a black box may still foretell"
    assert rest(0.0, 0.3).startswith("noise but for 0 to 30 %")
    # a log that bounds it from below alone, or not at all
    assert rest(0.03, 1.0) == "noise but for 3 % or more, which a black box may still foretell"
    assert rest(0.0, 1.0).endswith("this log cannot tell")
