"""The utility of an ambiguity group, computed by hand."""

from __future__ import annotations

import numpy as np
import pytest

from avtorch.errors import InputError
from benchmarks.blindtest.ambiguity import causes, group_utility, utility

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
