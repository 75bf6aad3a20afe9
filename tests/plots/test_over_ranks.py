"""Bands around ranks hold what they promise, and what is drawn is what was counted."""

from __future__ import annotations

import numpy as np
import pytest
from matplotlib.figure import Figure

from avtorch import plots
from avtorch.errors import InputError
from avtorch.validation.uniformity import ecdf_band
from tests.bars import BAR


def axes():
    return Figure().subplots()


def all_inside(counts: dict, **options) -> bool:
    bands = plots.rank_band(counts, **options)
    relative = {name: c * len(c) / c.sum() - 1 for name, c in counts.items()}
    return all((bands[n][0] <= r).all() and (r <= bands[n][1]).all() for n, r in relative.items())


def test_ranks_in_a_pool() -> None:
    counts = plots.pooled_rank_counts({"low": [1.0, 2.0], "high": [3.0, 4.0, 5.0, 6.0]}, bins=3)
    assert counts["low"].tolist() == [2, 0, 0]
    assert counts["high"].tolist() == [0, 2, 2]
    with pytest.raises(InputError, match="groups: found sizes"):
        plots.pooled_rank_counts({"alone": [1.0]})


@pytest.mark.statistical
@pytest.mark.parametrize("sizes", [(800, 800, 800, 2000), (300,)])
def test_band_holds_all_bars_at_its_level(sizes: tuple[int, ...], rotating_seed: int, draws_factor: int) -> None:
    rng, trials = np.random.default_rng(rotating_seed), 400 * draws_factor
    held = 0
    for _ in range(trials):
        drawn = {f"group {i}": rng.random(n) for i, n in enumerate(sizes)}
        if len(sizes) > 1:
            counts = plots.pooled_rank_counts(drawn, bins=10)
        else:
            counts = {"ranks": np.histogram(drawn["group 0"], np.linspace(0, 1, 11))[0]}
        held += all_inside(counts)
    # Bonferroni errs on the wide side only
    assert held / trials >= 0.95 - BAR * (0.95 * 0.05 / trials) ** 0.5


@pytest.mark.statistical
def test_band_counts_correlated_draws_by_effective_sample_size(rotating_seed: int, draws_factor: int) -> None:
    rng, trials = np.random.default_rng(rotating_seed), 300 * draws_factor
    held = {"worth": 0, "all": 0}
    for _ in range(trials):
        # every draw five times over: a fifth of them is what they are worth
        drawn = {"chain": np.repeat(rng.random(200), 5) + 1e-9 * rng.random(1000), "exact": rng.random(1000)}
        counts = plots.pooled_rank_counts(drawn, bins=10)
        held["worth"] += all_inside(counts, effective={"chain": 200.0})
        held["all"] += all_inside(counts)
    assert held["worth"] / trials >= 0.95 - BAR * (0.95 * 0.05 / trials) ** 0.5
    assert held["all"] / trials < 0.6


def test_bars_outside_the_band_are_crossed() -> None:
    even, odd = np.full(10, 100), np.full(10, 100)
    odd[0], odd[9] = 30, 170
    ax = axes()
    assert plots.rank_plot(ax, {"SGLD 1–4": even, "NUTS": odd}) is ax
    crossed = [np.asarray(line.get_xdata(), float) for line in ax.lines if line.get_marker() == "x"]
    assert [len(c) for c in crossed] == [0, 2]
    assert np.allclose(crossed[1], [0.05, 0.95])
    assert [t.get_text() for t in ax.get_yticklabels()] == ["SGLD 1–4", "NUTS"]


@pytest.mark.statistical
def test_ecdf_of_uniform_values_stays_in_its_band(rotating_seed: int, draws_factor: int) -> None:
    rng, trials = np.random.default_rng(rotating_seed), 400 * draws_factor
    low, high = (side.numpy() for side in ecdf_band(500, 99))
    held = 0
    for _ in range(trials):
        share = plots.ecdf_of(rng.random(500))
        held += bool(((low <= share + 1e-12) & (share <= high + 1e-12)).all())
    assert abs(held / trials - 0.955) <= 0.02 + BAR * (0.95 * 0.05 / trials) ** 0.5


def test_ecdf_difference_is_drawn_less_the_uniform() -> None:
    ax = axes()
    share = plots.ecdf_of(np.full(50, 0.305))
    assert plots.ecdf_difference(ax, {"all at one place": share}, ecdf_band(50, 99)) is ax
    line = next(line for line in ax.lines if line.get_label() == "all at one place")
    x, y = np.asarray(line.get_xdata(), float), np.asarray(line.get_ydata(), float)
    assert np.allclose(y, (x > 0.305) - x)
    assert ax.get_ylim()[0] == -ax.get_ylim()[1]
