"""Probabilities of parts follow their evidence, and the file in use is one that the script can make."""

from __future__ import annotations

import json

import numpy as np
import pytest
from scipy.special import expit

from avtorch.gap.budget.held_out_evidence import Evidence
from avtorch.gap.budget.part_odds import PATH, SCHEMA, PartOdds, by_agreement, figures
from benchmarks.part_odds import fit, left_out, none_and_outside, scores, verdicts

ODDS, BOTH = PartOdds.read(), ("speed", "accel")


def test_more_evidence_is_more_probable() -> None:
    each = [
        ODDS.probability(Evidence(nats, errors, 8.0), response=0.15, channels=BOTH, tried=22)
        for nats, errors in ((2, 1), (20, 3), (80, 8), (800, 40))
    ]
    assert each == sorted(each)
    # of the simulated parts with as much, some one in six stand for another effect
    assert each[0] < 0.1 < 0.8 < each[-1] < 1.0


def test_of_many_tried_one_is_more_often_wrong() -> None:
    evidence = Evidence(20.0, 40.0, 80.0)
    one, many = (ODDS.probability(evidence, response=0.15, channels=BOTH, tried=tried) for tried in (1, 20))
    assert one / (1 - one) == pytest.approx(20 * many / (1 - many))


def test_agreement_of_few_blocks_is_no_surer_than_students_law_unless_much_is_gained() -> None:
    """Of 100 drives of a minute without a cause, three effects tried, seven got one that gained 10 to 25 nats."""
    alarm, plain = Evidence(16.5, 2.8, 6.5), Evidence(120.6, 4.76, 2.0)
    assert ODDS.probability(alarm, response=0.15, channels=BOTH, tried=3) == pytest.approx(by_agreement(alarm, 3))
    assert alarm.strength(3) < 0
    assert plain.strength(22) < 0
    assert ODDS.probability(plain, response=0.15, channels=BOTH, tried=22) > 0.5


def test_more_of_the_response_is_more_probable() -> None:
    small, large = (
        ODDS.probability(Evidence(30.0, 6.0, 9.0), response=r, channels=BOTH, tried=22) for r in (0.02, 0.2)
    )
    assert small < large


def test_without_a_speed_a_part_is_less_likely() -> None:
    """Effects that need one are not tried there, and others stand in for them: 0.65 of their names are right."""
    speed, accel = (
        ODDS.probability(Evidence(60.0, 9.0, 9.0), response=0.15, channels=(channel,), tried=12)
        for channel in ("speed", "accel")
    )
    assert accel < speed


def test_no_evidence_is_no_error() -> None:
    assert 0.0 < ODDS.probability(Evidence(-50.0, -3.0, 1.0), response=0.15, channels=BOTH, tried=22) < 0.05


def test_the_file_names_its_cases() -> None:
    document = json.loads(PATH.read_text(encoding="utf-8"))
    assert document["schema"] == SCHEMA
    made = document["provenance"]
    assert {entry["recorder"] for entry in made["cases"]} == {"ideal", "ordinary", "recording"}
    assert {entry["signals"] for entry in made["cases"]} >= {"accel speed", "speed", "accel"}
    assert any("outside" in entry["mix"] for entry in made["cases"])
    assert made["left_out"]["log_loss"] < made["students_law"]["log_loss"]


@pytest.mark.statistical
def test_the_fit_finds_the_odds_that_made_the_parts(rotating_seed: int) -> None:
    rng = np.random.default_rng(rotating_seed)
    parts = 4000
    drawn = np.exp(rng.normal((3.0, 1.5, -2.3), (1.0, 1.0, 0.5), (parts, 3)))
    channels = [BOTH if both else ("accel",) for both in rng.random(parts) < 0.5]
    rows = np.array([figures(Evidence(n, e, 8.0), r, own) for (n, e, r), own in zip(drawn, channels, strict=True)])
    tried = np.full(parts, np.log(20.0))
    wanted = np.array([1.0, 0.8, 0.8, 0.8, -1.0])
    odds = rows @ wanted - tried
    there = rng.random(parts) < expit(odds)
    found = fit(rows, tried, there)
    weight = expit(odds) * expit(-odds)
    covariance = np.linalg.inv((rows * weight[:, None]).T @ rows)
    far = found.weights - wanted
    # chi-square of five degrees of freedom, one in 10,000; rounding to three digits and the ridge are far smaller
    assert far @ np.linalg.solve(covariance, far) < 25.7


def test_figures_of_a_small_set() -> None:
    cases = [{"kind": "none"}, {"kind": "none"}, {"kind": "single"}, {"kind": "single"}]
    there, of = np.array([False, True, True]), np.array([1, 2, 3])
    found = scores(np.array([0.6, 0.9, 0.2]), there, of, cases)
    assert found["named"] == 2
    assert found["of_them_there"] == 0.5
    assert found["there_and_named"] == 0.5
    assert (found["without_a_cause"], found["of_them_accused"]) == (2, 1)


def test_what_cases_without_a_likely_part_have() -> None:
    cases = [{"kind": kind} for kind in ("none", "single", "outside", "outside")]
    probability, there, of = np.array([0.9, 0.8, 0.3]), np.array([True, False, False]), np.array([1, 2, 3])
    assert verdicts(probability, there, of, cases) == (["none", "outside"], ["outside"])
    assert none_and_outside(["none", "none", "outside"]) == pytest.approx((2.5 / 4.5, 1.5 / 4.5))
    assert none_and_outside([]) == pytest.approx((1 / 3, 1 / 3))  # as likely as a known one


def test_a_part_is_never_judged_by_its_own_case() -> None:
    rows = np.array([figures(Evidence(20.0, 4.0, 8.0), 0.1, BOTH)] * 40)
    there, of = np.arange(40) % 2 == 0, np.arange(40) // 2
    assert left_out(rows, np.zeros(40), there, of, np.ones(40)) == pytest.approx(
        0.5, abs=0.05
    )  # one of each in every case
