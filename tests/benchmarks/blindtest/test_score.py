"""The score, on answers whose score is known beforehand; and the utility of an ambiguity group, computed by hand."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import binom

from avtorch.errors import InputError
from benchmarks.blindtest.ambiguity import causes, group_utility, utility
from benchmarks.blindtest.answers import canonical_name, read_answer
from benchmarks.blindtest.catalogue import EFFECTS
from benchmarks.blindtest.intervals import bootstrap, cases_for, cases_for_mean, wilson
from benchmarks.blindtest.score import score
from tests.bars import BAR

NAMES = list(EFFECTS)
CANDIDATES = [*NAMES, "none", "unknown"]


def truths(rounds: int = 2) -> list[dict]:
    made = []
    for i in range(rounds * 40):
        kind = ("none", "none", "single", "single", "single", "single", "pair", "outside")[i % 8]
        one, two = sorted((NAMES[i % 22], NAMES[(i + 7) % 22]))
        verdict = {"none": "none", "single": NAMES[i % 22], "pair": f"{one}+{two}", "outside": "unknown"}[kind]
        made.append(
            {
                "case": f"case_{i:05d}",
                "kind": kind,
                "verdict": verdict,
                "tier": None if kind == "none" else ("easy", "medium", "hard", "faint")[(i // 8) % 4],
                "onset_s": None if kind == "none" or i % 3 == 0 else 30.0,
                "onset_scored": True,
                "drive": {"seconds": 60.0},
                "oracle": {"rollout_rmse_accel": {"before": 0.4, "after": 0.1, "floor": 0.1, "closed": 1.0}},
            }
        )
    return made


def answer(
    probabilities: dict[str, float], verdict: str, *, alias: tuple[str, ...] = (), onset=None, closed=None
) -> dict:
    listed = {"none": 0.0, "unknown": 0.0} | probabilities
    return {
        "schema": "avtorch.diagnosis/1",
        "effects": [{"name": n, "probability": p, "log_evidence": 0.0, "parameters": {}} for n, p in listed.items()],
        "verdict": {
            "names": verdict.split("+"),
            "alias_set": [verdict, *alias],
            "abstained": verdict == "unknown",
            "why": "",
        },
        "onset_s": onset,
        "shrinkage": {
            "metric": "rollout_rmse_accel",
            "before": 0.4,
            "after": 0.1,
            "floor": 0.1,
            "closed": None if closed is None else {"mean": closed, "q05": 0.9, "q95": 1.0},
        },
    }


def perfect(truth: dict) -> dict:
    return answer({truth["verdict"]: 1.0}, truth["verdict"], onset=truth["onset_s"], closed=1.0)


def test_perfect_answers() -> None:
    cases = truths()
    s = score(cases, [perfect(t) for t in cases], seconds=[2.0] * len(cases), resamples=50)
    assert s["cases"] == len(cases)
    assert s["top1"] == dict.fromkeys(("easy", "medium", "hard", "faint"), 1.0)
    assert s["alias_set"]["accuracy"] == s["alias_set"]["mean_size"] == 1.0
    assert (s["false_alarm"], s["unknown_fpr95"], s["unknown_confidently_blamed"]) == (0.0, 0.0, 0.0)
    assert (s["unknown_auroc"], s["macro_f1"], s["pairs_exact"], s["pairs_jaccard"]) == (1.0, 1.0, 1.0, 1.0)
    assert (s["ece"], s["brier"], s["confident_errors"]) == (0.0, 0.0, 0.0)
    assert s["closed_error"] == pytest.approx(0.0)
    assert (s["onset_error_s"], s["seconds_per_case"], s["placebo_closed"]) == (0.0, 2.0, None)
    assert all(list(row) == [truth] for truth, row in s["confusion"].items())
    assert s["intervals"]["false_alarm"] == [0.0, wilson(0, s["counts"]["false_alarm"])[1]]  # type: ignore[index]


def test_always_none() -> None:
    cases = truths()
    s = score(cases, [answer({"none": 1.0}, "none") for _ in cases], resamples=50)
    assert s["top1"] == dict.fromkeys(("easy", "medium", "hard", "faint"), 0.0)
    assert s["false_alarm"] == 0.0
    assert s["unknown_auroc"] == pytest.approx(0.5)
    assert s["unknown_fpr95"] == 1.0
    assert s["confident_errors"] == s["ece"] == pytest.approx(0.75)
    assert s["brier"] == pytest.approx(1.5)
    assert s["pairs_jaccard"] == 0.0
    assert s["closed_error"] is None


@pytest.mark.statistical
def test_random_guess(rotating_seed: int) -> None:
    rng = np.random.default_rng(rotating_seed)
    cases = truths(10)
    share = 1 / len(CANDIDATES)
    given = []
    for _ in cases:
        noisy = rng.dirichlet(np.full(len(CANDIDATES), 50.0))
        given.append(answer(dict(zip(CANDIDATES, noisy.tolist(), strict=True)), str(rng.choice(CANDIDATES))))
    s = score(cases, given, resamples=50)
    singles = sum(t["kind"] == "single" for t in cases)
    right = np.mean([s["top1"][tier] for tier in s["top1"]])
    assert right == pytest.approx(share, abs=BAR * np.sqrt(share / singles))
    assert s["false_alarm"] == pytest.approx(1 - share, abs=BAR * np.sqrt(share / 100))
    # the spread of the AUROC of 50 against 350 under no skill is 0.044
    assert s["unknown_auroc"] == pytest.approx(0.5, abs=BAR * 0.044)
    assert s["confident_errors"] == 0.0
    low, high = s["intervals"]["unknown_auroc"]
    assert low < s["unknown_auroc"] < high


def test_errors_of_size_and_of_time() -> None:
    case = truths()[2] | {"onset_s": 30.0}
    said = answer({case["verdict"]: 0.8, "unknown": 0.2}, case["verdict"], onset=33.5, closed=0.7)
    one = read_answer(case, said)
    assert one.onset_error == pytest.approx(3.5)
    assert one.closed_error == pytest.approx(0.3)
    assert one.brier == pytest.approx(0.08)
    assert read_answer(case, said | {"onset_s": None}).onset_error == 60.0
    wrong = read_answer(case, answer({"none": 0.6, "unknown": 0.4}, "none", onset=33.5, closed=0.7))
    assert wrong.onset_error is None
    assert wrong.closed_error is None
    assert wrong.brier == pytest.approx(0.36 + 0.16 + 1.0)
    assert one.closed_covered is True  # the interval ends at 1, which is the oracle's
    sham = {"closed": {"mean": 0.02, "q05": -0.01}}
    assert read_answer(case, said | {"shrinkage": said["shrinkage"] | {"placebo": sham}}).placebo == sham["closed"]
    # half of the error is left, and of that the truth has a third for noise
    half = said["shrinkage"] | {"before": 0.7, "after": 0.4, "closed": {"mean": 0.45, "q05": 0.4, "q95": 0.55}}
    part = read_answer(case, said | {"shrinkage": half})
    assert part.closed_error == pytest.approx(abs(0.45 - 0.3 / 0.6))
    assert part.closed_covered is True
    assert read_answer(case, said | {"shrinkage": half | {"after": 0.3}}).closed_covered is False


def test_half_right_pairs_missing_answers_and_aliases() -> None:
    cases = truths()
    pair = next(t for t in cases if t["kind"] == "pair")
    single = next(t for t in cases if t["kind"] == "single")
    one = pair["verdict"].split("+")[0]
    swapped = "+".join(reversed(pair["verdict"].split("+")))
    assert canonical_name(swapped) == pair["verdict"]
    s = score([pair, pair], [answer({one: 1.0}, one), answer({swapped: 1.0}, swapped)], resamples=10)
    assert s["pairs_exact"] == 0.5
    assert s["pairs_jaccard"] == 0.75
    s = score([single, single], [None, answer({"none": 1.0}, "none", alias=(single["verdict"],))], resamples=10)
    assert s["confusion"] == {single["verdict"]: {"failed": 1, "none": 1}}
    assert s["alias_set"] == {
        "accuracy": 0.5,
        "mean_size": 1.0,
        "by_tier": s["alias_set"]["by_tier"],
    }


def test_calibration_error_of_known_size() -> None:
    cases = [t for t in truths() if t["kind"] == "single"][:20]
    given = [
        answer({t["verdict"]: 0.75, "none": 0.25}, t["verdict"])
        if i < 10
        else answer({"none": 0.75, t["verdict"]: 0.25}, "none")
        for i, t in enumerate(cases)
    ]
    found = score(cases, given, resamples=10)
    assert found["ece"] == pytest.approx(0.25)
    # 20 cases at 0.75: the mean distance of a binomial share, by its exact distribution
    share = np.arange(21) / 20
    by_chance = float((binom.pmf(np.arange(21), 20, 0.75) * np.abs(share - 0.75)).sum())
    spread = float(np.sqrt((binom.pmf(np.arange(21), 20, 0.75) * (np.abs(share - 0.75) - by_chance) ** 2).sum()))
    assert found["ece_by_chance"] == pytest.approx(by_chance, abs=BAR * spread / np.sqrt(1000))


def test_bad_answers_are_named() -> None:
    case = truths()[2]
    with pytest.raises(InputError, match=r"case_00002.*sum"):
        read_answer(case, answer({"none": 0.7}, "none"))
    broken = answer({"none": 1.0}, "none")
    broken["effects"] = [e for e in broken["effects"] if e["name"] == "none"]
    with pytest.raises(InputError, match="unknown"):
        read_answer(case, broken)
    with pytest.raises(InputError, match="answers"):
        score([case], [])


def test_how_many_cases_an_interval_of_five_points_takes() -> None:
    assert cases_for(0, 0) == 268  # the worst case, a share of a half
    for hits, trials in ((5, 10), (9, 10), (60, 100), (2, 2)):
        needed = cases_for(hits, trials)
        middle = sum(wilson(hits, trials) or ()) / 2
        low, high = wilson(round(middle * needed), needed) or (0, 0)
        assert (high - low) / 2 == pytest.approx(0.05, rel=0.02)
    assert cases_for(500, 1000) == 1000  # enough
    assert cases_for(2, 2) > cases_for(20, 20) > cases_for(60, 60)
    assert cases_for_mean((0.4, 0.6), 50) == 200
    assert cases_for_mean((0.46, 0.54), 50) == 50
    assert cases_for_mean((0.5, 0.5), 3) == 30
    assert cases_for_mean(None, 0) is None


def test_needed_cases_stand_beside_the_shares() -> None:
    cases = truths()
    s = score(cases, [perfect(t) for t in cases], resamples=10)
    count = s["counts"]["false_alarm"]
    assert s["needed"]["false_alarm"] == cases_for(0, count)
    assert s["needed"]["top1"].keys() == s["top1"].keys()
    assert s["needed"]["several"]["recall"] is None  # no such case


@pytest.mark.statistical
def test_intervals_cover(rotating_seed: int, draws_factor: int) -> None:
    low, high = wilson(8, 10)  # type: ignore[misc]
    assert (low, high) == pytest.approx((0.5407, 0.9315), abs=2e-3)
    assert wilson(0, 0) is None
    rng = np.random.default_rng(rotating_seed)
    hit, trials = 0, 200 * draws_factor
    for i in range(trials):
        x = rng.normal(size=60)
        a, b = bootstrap(lambda index, x=x: float(x[index].mean()), 60, resamples=200, seed=i)  # type: ignore[misc]
        hit += a < 0 < b
    # nominal 0.90, the percentile bootstrap of 60 gives 0.885
    assert hit / trials == pytest.approx(0.885, abs=BAR * np.sqrt(0.885 * 0.115 / trials))


# The utility of an ambiguity group, computed by hand.
A, B, AB, NONE = frozenset("a"), frozenset("b"), frozenset("ab"), frozenset[str]()


@pytest.mark.parametrize(
    ("diagnosed", "true", "worth"),
    [
        (A, A, 1.0),
        (NONE, NONE, 1.0),
        (AB, A, 1 - 1 * 3 / (10 * 2)),  # one sound part too many, of two
        (A, AB, 1 - 1 * 10 / (10 * 2)),  # one of the nine parts held to be sound is not
        (NONE, A, 1 - 1 * 11 / (10 * 2)),
        (B, A, 1 - 1 * 2 / (10 * 2) - 1 * 10 / (10 * 2)),
        (frozenset("abcdefghij"), NONE, 1 - 10 * 11 / (10 * 11)),  # all accused, all sound
    ],
)
def test_one_diagnosis_of_ten_components(diagnosed: frozenset[str], true: frozenset[str], worth: float) -> None:
    assert utility(diagnosed, true, 10) == pytest.approx(worth, abs=1e-12)


def test_it_is_between_0_and_1_and_1_for_the_truth_alone(fresh_seed: int) -> None:
    rng = np.random.default_rng(fresh_seed)
    for _ in range(200):
        one, other = (frozenset(np.flatnonzero(rng.random(8) < rng.random()).astype(str).tolist()) for _ in range(2))
        worth = utility(one, other, 8)
        assert -1e-12 <= worth <= 1 + 1e-12
        assert (worth == pytest.approx(1.0, abs=1e-12)) == (one == other)


def test_a_group_is_the_mean_of_its_pairs_over_the_true_groups() -> None:
    wrong = utility(B, A, 10)
    assert group_utility([A, B], [A], 10) == pytest.approx((1 + wrong) / 2)
    assert group_utility({A: 0.9, B: 0.1}, [A], 10) == pytest.approx(0.9 + 0.1 * wrong)
    assert group_utility({A: 0.0, B: 0.0}, [A], 10) == group_utility([A, B], [A], 10)
    # where the truth is as ambiguous, the whole group is worth 1
    assert group_utility([A, B], [B, A], 10) == pytest.approx(1.0)
    assert group_utility([AB], [A, B], 10) == pytest.approx(utility(AB, A, 10) / ((1 + wrong) / 2))


def test_names_of_hypotheses_and_what_it_refuses() -> None:
    assert causes("none") == NONE
    assert causes("unknown") == frozenset({"unknown"})
    assert causes("dead_time+gust") == frozenset({"dead_time", "gust"})
    with pytest.raises(InputError, match="group: found no diagnosis"):
        group_utility([], [A])
    with pytest.raises(InputError, match="components: found 1"):
        utility(AB, A, 1)
