"""Answers of `avtorch.diagnosis/2`: what they name, how they divide the gap, and how both are scored."""

from __future__ import annotations

from typing import Any

import pytest

from avtorch.errors import InputError
from benchmarks.blindtest import budget_score as of
from benchmarks.blindtest.ambiguity import utility
from benchmarks.blindtest.answers import read_answer
from benchmarks.blindtest.score import score
from tests.benchmarks.blindtest.test_score import answer, perfect, truths

SHARES = {"road_grade": 0.6, "dead_time": 0.3, "sensor_bias": 0.1}


def share(mean: float) -> dict[str, float]:
    return {"mean": mean, "q05": mean - 0.05, "q95": mean + 0.05}


def divided(
    parts: dict[str, float] | None,
    *,
    probability: float = 0.9,
    chance: tuple[str, ...] = (),
    unexplained: float = 0.0,
    material: bool = False,
    unsure: dict[str, float] | None = None,
    aliases: dict[str, list[str]] | None = None,
    onset: float | None = None,
) -> dict[str, Any]:
    """An answer with a budget of `parts` (None: no budget, `none`), `unsure` ones of probability 0.3 besides."""
    listed = [(name, x, probability) for name, x in (parts or {}).items()]
    listed += [(name, x, 0.3) for name, x in (unsure or {}).items()]
    made = [
        {
            "names": [name],
            "alias_set": [name, *(aliases or {}).get(name, [])],
            "probability": p,
            "share": share(x),
            "after": 1.0,
            "parameters": {},
            "onset_s": onset,
            "plausible": True,
        }
        for name, x, p in listed
    ]
    names = [*(parts or {}), *chance] or ["unknown" if material else "none"]
    said = "+".join(sorted(names))
    budget = {
        "metric": "rollout_10s_over_floor",
        "horizon_s": 10.0,
        "heldout_by": "blocks",
        "before": 3.0,
        "floor": 1.0,
        "left": 1.0,
        "parts": made,
        "chance": [{"names": [n], "probability": 0.8, "share_of_noise": 0.3, "parameters": {}} for n in chance],
        "unexplained": {"share": share(unexplained), "material": material, "where": [], "resembles": None},
    }
    bare = answer({said: 0.9, "unknown" if said != "unknown" else "none": 0.1}, said)
    partial = material and said != "unknown"
    return bare | {
        "schema": "avtorch.diagnosis/2",
        "verdict": bare["verdict"] | {"names": names, "partial": partial},
        "budget": None if parts is None else budget,
    }


def several(index: int = 0, *, outside: bool = False, unexplained: float = 0.0) -> dict[str, Any]:
    parts = [{"names": [name], "share": x * (1 - unexplained), "after": 1.0} for name, x in SHARES.items()]
    budget = {"parts": parts, "chance": [{"names": ["gust"]}], "unexplained": {"share": unexplained}}
    return {
        "case": f"case_{index:05d}",
        "kind": "several",
        "verdict": "dead_time+gust+road_grade+sensor_bias",
        "tier": "easy",
        "onset_s": None,
        "onset_scored": True,
        "drive": {"seconds": 60.0},
        "budget": budget,
        "outside": ["stiction"] if outside else [],
    }


def test_a_right_division_is_without_error() -> None:
    case = several()
    s = score([case], [divided(SHARES, chance=("gust",))], resamples=10)
    assert s["several"] == {
        "recall": pytest.approx(1.0),
        "precision": pytest.approx(1.0),
        "sum_error": pytest.approx(0.0),
        "share_error": pytest.approx(0.0),
        "unexplained_error": 0.0,
        "leading": 1.0,
        "exact": 1.0,
        "extra": 0.0,
    }
    assert s["utility"]["by_kind"]["several"] == pytest.approx(1.0)
    assert (s["partial_wrong"], s["unknown_auroc"], s["top1"]["easy"]) == (0.0, None, None)
    assert s["part_ece"] == pytest.approx((3 * 0.1 + 0.2) / 4)  # parts at 0.9, gusts at 0.8, all of them there


def test_names_weigh_by_their_shares() -> None:
    one = read_answer(several(), divided({"dead_time": 0.4, "backlash": 0.1}, unexplained=0.5, material=True))
    assert one.named == ("backlash", "dead_time")
    assert one.partial
    assert of.recall([one]) == pytest.approx(0.3)  # the oracle's share of the one that is right
    assert of.precision([one]) == pytest.approx(0.8)  # the answer's
    assert of.sum_error(one) == pytest.approx(0.5)
    assert of.unexplained_error(one) == pytest.approx(0.5)
    assert of.share_error(one) == pytest.approx((0.6 + 0.1 + 0.1) / 3)
    assert of.extra_names(one)
    assert not of.leading_right(one)
    assert not one.right


def test_parts_that_are_not_named_do_not_count_as_names() -> None:
    case = several()
    sure = divided({"road_grade": 0.6}, unsure={"dead_time": 0.3}, unexplained=0.1)
    one = read_answer(case, sure)
    assert one.named == ("road_grade",)
    assert of.recall([one]) == pytest.approx(0.6)
    assert of.sum_error(one) == pytest.approx(0.4)
    assert of.leading_right(one)
    assert of.part_probabilities(one) == [(0.9, True), (0.3, True)]


def test_answers_without_a_budget_have_names_alone() -> None:
    case = several()
    old = read_answer(case, answer({"dead_time+road_grade": 1.0}, "dead_time+road_grade"))
    assert (old.budget, old.partial) == (None, False)
    assert of.recall([old]) == pytest.approx(0.9)
    assert of.precision([old]) == 1.0
    wrong = read_answer(case, answer({"backlash+road_grade": 1.0}, "backlash+road_grade"))
    assert of.precision([wrong]) == 0.5
    assert (of.sum_error(old), of.unexplained_error(old), of.part_probabilities(old)) == (None, None, [])
    nothing = read_answer(case, divided(None))
    assert (of.recall([nothing]), of.precision([nothing]), of.extra_names(nothing)) == (0.0, None, False)
    failed = read_answer(case, None)
    assert (of.recall([failed]), of.precision([failed]), failed.utility()) == (0.0, None, 0.0)
    s = score([case, case], [None, divided(SHARES, chance=("gust",))], resamples=10)
    assert s["several"]["recall"] == pytest.approx(0.5)
    assert s["counts"]["several"] | {"precision": 2, "leading": 2} != s["counts"]["several"]  # of one alone


def test_a_small_rest_beside_a_cause_outside_the_table_weighs_little() -> None:
    whole, rest = several(), several(outside=True, unexplained=0.9)
    rows = [read_answer(whole, divided(SHARES)), read_answer(rest, divided({}, unexplained=1.0, material=True))]
    # of 1 + 0.1 of the two gaps
    assert of.recall(rows) == pytest.approx(1 / 1.1)
    assert of.precision(rows) == 1.0
    wrong = read_answer(rest, divided({"backlash": 0.25}, unexplained=0.75, material=True))
    assert of.precision([rows[0], wrong]) == pytest.approx(1 / 1.25)


def outside_case() -> dict[str, Any]:
    return next(t for t in truths() if t["kind"] == "outside")


@pytest.mark.parametrize(
    ("said", "blamed"),
    [
        (divided({"dead_time": 1.0}), True),
        (divided({"dead_time": 0.6}, unexplained=0.4, material=True), False),
        (divided({}, unexplained=1.0, material=True), False),
        (divided(None), False),
        (answer({"dead_time": 0.6, "unknown": 0.4}, "dead_time"), True),  # the first schema knows no rest
        (answer({"dead_time": 0.4, "unknown": 0.6}, "unknown"), False),
        (None, False),
    ],
)
def test_an_outside_cause_is_blamed_on_effects_alone(said: dict | None, blamed: bool) -> None:
    assert read_answer(outside_case(), said).blamed_alone is blamed
    assert score([outside_case()], [said], resamples=5)["blamed_alone"] == float(blamed)


def test_a_rest_beside_what_is_named_is_right_only_where_there_is_one() -> None:
    case = several(outside=True, unexplained=0.4)
    said = divided({name: 0.6 * x for name, x in SHARES.items()}, chance=("gust",), unexplained=0.4, material=True)
    s = score([case], [said], resamples=5)
    assert s["several"]["unexplained_error"] == pytest.approx(0.0)
    assert s["several"]["sum_error"] == pytest.approx(0.0)
    assert s["utility"]["group"] == pytest.approx(1.0)  # the cause outside the table is found, too
    assert s["partial_wrong"] is None
    assert score([several()], [said], resamples=5)["partial_wrong"] == 1.0
    # neither `unknown` nor its absence is wrong of such a case, so it is not among those that unknown is told from
    none = truths()[0]
    s = score([case, outside_case(), none], [said, perfect(outside_case()), perfect(none)], resamples=5)
    assert s["counts"]["unknown_auroc"] == 2
    assert s["unknown_auroc"] == 1.0


def test_one_effect_and_two_are_right_as_sets() -> None:
    single, pair = (next(t for t in truths() if t["kind"] == kind) for kind in ("single", "pair"))
    one, two = pair["verdict"].split("+")
    s = score(
        [single, single, pair, pair],
        [
            divided({single["verdict"]: 1.0}),
            divided({single["verdict"]: 0.9, "gear_shift": 0.1}),
            divided({two: 0.7, one: 0.3}),
            divided({one: 1.0}),
        ],
        resamples=5,
    )
    assert s["top1"][single["tier"]] == 0.5
    assert (s["pairs_exact"], s["pairs_jaccard"]) == (0.5, 0.75)


def test_aliases_of_parts_are_replaced_one_at_a_time() -> None:
    case = next(t for t in truths() if t["kind"] == "pair") | {"verdict": "dead_time+gust"}
    said = divided(
        {"dead_time": 0.7, "road_grade": 0.3},
        aliases={"dead_time": ["sensor_lag"], "road_grade": ["gust", "constant_resistance"]},
    )
    one = read_answer(case, said)
    assert one.alias_set == {
        "dead_time+road_grade",
        "road_grade+sensor_lag",
        "dead_time+gust",
        "constant_resistance+dead_time",
    }
    pairs = [frozenset(name.split("+")) for name in one.alias_set]
    true = frozenset({"dead_time", "gust"})
    assert one.utility() == pytest.approx(sum(utility(p, true) for p in pairs) / 4)
    # the verdict alone has a probability
    assert one.utility(weighted=True) == pytest.approx(utility(frozenset({"dead_time", "road_grade"}), true))
    listed = said | {"verdict": said["verdict"] | {"alias_set": ["dead_time+road_grade", "gust"]}}
    assert read_answer(case, listed).alias_set == {"dead_time+road_grade", "gust"}


def test_an_onset_of_a_part_is_that_of_the_answer() -> None:
    case = next(t for t in truths() if t["kind"] == "single") | {"onset_s": 30.0}
    said = divided({case["verdict"]: 1.0}, onset=34.0)
    assert read_answer(case, said).onset_error == pytest.approx(4.0)
    assert read_answer(case, said | {"onset_s": 31.0}).onset_error == pytest.approx(1.0)
    assert read_answer(case, divided({case["verdict"]: 1.0})).onset_error == 60.0


def broken(change: dict[str, Any]) -> dict[str, Any]:
    said = divided({"dead_time": 1.0})
    part = said["budget"]["parts"][0] | change
    return said | {"budget": said["budget"] | {"parts": [part]}}


@pytest.mark.parametrize(
    ("said", "told"),
    [
        (broken({"names": ["dead_time", "gust"]}), "a part of 2 names"),
        (broken({"probability": 1.2}), "dead_time has probability 1.2"),
        (divided({"dead_time": 1.0}) | {"schema": "avtorch.diagnosis/3"}, r"found schema 'avtorch.diagnosis/3', needs"),
    ],
)
def test_broken_budgets_are_named(said: dict, told: str) -> None:
    with pytest.raises(InputError, match=told):
        read_answer(several(), said)
