"""Verdicts come from figures by the rules that the module states, and intervals hold what they promise."""

from __future__ import annotations

import math

import pytest
import torch

from avtorch.paper.rows import ClaimRow, error, median_interval, number_list, share, sign, spread, within


def test_rules() -> None:
    assert error(0.17, (0.05, 0.16)) == "better"
    assert error(0.17, (0.05, 0.17)) == "same"
    assert error(0.17, (0.18, 0.3)) == "not reproduced"
    assert sign((0.1, 0.9), above=0.0) == "same"
    assert sign((-0.1, 0.9), above=0.0) == "not reproduced"
    assert sign((0.96, 1.04), above=0.95, below=1.05) == "same"
    assert sign(1.0, below=1.0) == "not reproduced"
    assert (share(0.95), share(0.94)) == ("same", "not reproduced")
    assert (within(0.9, 0.85, 0.95), within(0.96, 0.85, 0.95)) == ("same", "not reproduced")


def test_what_is_not_finite_is_never_the_same() -> None:
    assert sign((math.nan, math.nan), below=1.0) == "not reproduced"
    assert error(0.1, (math.nan, math.nan)) == "not reproduced"


@pytest.mark.statistical
def test_intervals_hold_the_truth_as_often_as_they_say(rotating_seed: int, draws_factor: int) -> None:
    trials, runs = 400 * draws_factor, 40
    generator = torch.Generator().manual_seed(rotating_seed)
    values = torch.randn(trials, runs, generator=generator, dtype=torch.float64)
    held = sum(low <= 0.0 <= high for low, high in (median_interval(v, i) for i, v in enumerate(values)))
    # a bootstrap of 40 values holds some 88 %; five standard errors of 400 trials are 7.5 points
    assert 0.80 < held / trials < 0.985


def test_spread_and_words() -> None:
    assert spread(torch.arange(101.0)) == (5.0, 95.0)
    assert number_list([0.1, 0.2, 3.0]) == "0.1, 0.2 and 3"
    assert number_list([2.5]) == "2.5"
    row = ClaimRow("gains", "s", "q", 1.0, 2.0, (1.0, 3.0), "same", "w.").as_dict()
    assert row["interval"] == [1.0, 3.0]
    assert list(row) == ["name", "setting", "quantity", "paper", "ours", "interval", "verdict", "why"]
