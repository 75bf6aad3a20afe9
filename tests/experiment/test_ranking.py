"""The rank correlation is SciPy's, its p-value counts the orders, and the regret is of the chosen setting."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.stats import spearmanr

from avtorch.errors import InputError
from avtorch.experiment import rank_agreement


def named(values: np.ndarray) -> dict[str, float]:
    return {f"s{k}": float(x) for k, x in enumerate(values)}


@pytest.mark.parametrize("size", [3, 5, 8, 12])
def test_it_is_spearmans(size: int) -> None:
    rng = np.random.default_rng(size)
    a, b = rng.integers(0, 6, (2, size)).astype(float)  # with ties
    a[:2], b[:2] = (0, 1), (2, 0)
    assert rank_agreement(named(a), named(b)).srcc == pytest.approx(spearmanr(a, b).statistic, abs=1e-9)


def test_p_values_of_small_sets_are_exact() -> None:
    up = named(np.arange(4.0))
    assert rank_agreement(up, up).p_value == pytest.approx(1 / 24)
    down = named(-np.arange(4.0))
    assert rank_agreement(up, down).p_value == 1.0
    assert rank_agreement(up, down).srcc == -1.0


def test_p_values_of_larger_sets_come_near() -> None:
    up = named(np.arange(9.0))
    swapped = named(np.array([1.0, 0.0, 2.0, 4.0, 3.0, 5.0, 6.0, 8.0, 7.0]))
    found = rank_agreement(up, swapped)
    assert 0 < found.p_value <= 5 / 20_000 + 5 * math.sqrt(1e-4 / 20_000)  # orders as near are fewer than 1 in 10,000


@pytest.mark.parametrize(("higher", "chosen", "regret"), [(False, "a", 0.3), (True, "c", 0.2)])
def test_the_regret_is_what_the_choice_costs(higher: bool, chosen: str, regret: float) -> None:
    simulated, real = {"a": 1.0, "b": 2.0, "c": 3.0}, {"c": 0.8, "b": 1.0, "a": 0.9}
    real["a"] = 1.1 if not higher else 0.9
    found = rank_agreement(simulated, real, higher_is_better=higher)
    assert found.chosen == chosen
    assert found.regret == pytest.approx(regret)


@pytest.mark.parametrize(
    ("simulated", "real"),
    [
        ({"a": 1.0, "b": 2.0}, {"a": 1.0, "b": 2.0}),
        ({"a": 1.0, "b": 2.0, "c": 3.0}, {"a": 1.0, "b": 2.0, "d": 3.0}),
        ({"a": 1.0, "b": 2.0, "c": math.nan}, {"a": 1.0, "b": 2.0, "c": 3.0}),
        ({"a": 1.0, "b": 1.0, "c": 1.0}, {"a": 1.0, "b": 2.0, "c": 3.0}),
    ],
)
def test_what_cannot_be_ranked(simulated: dict[str, float], real: dict[str, float]) -> None:
    with pytest.raises(InputError, match="needs"):
        rank_agreement(simulated, real)
