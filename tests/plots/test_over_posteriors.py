"""Drawings of posteriors: the numbers that they show are the right ones."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from matplotlib.figure import Figure
from matplotlib.patches import StepPatch
from scipy.stats import gamma

from avtorch import plots
from avtorch.inference import Posterior, Quadrature
from avtorch.plots.posteriors import agreement_scatter, exact_density, joint_cloud
from tests.bars import BAR

NAMES = ("T_L", "K_L", "sigma")
MEAN, SD = (0.3, 1.0, 0.1), (0.06, 0.1, 0.01)


def axes():
    return Figure().subplots()


def laws() -> list:
    return [gamma((m / s) ** 2, scale=s * s / m) for m, s in zip(MEAN, SD, strict=True)]


def quadrature() -> Quadrature:
    """One window of gamma marginals, as a grid of 49 nodes over their logarithm would give them."""
    nodes, mass = [], []
    for law in laws():
        z = np.linspace(math.log(law.ppf(1e-9)), math.log(law.isf(1e-9)), 49)
        weight = law.pdf(np.exp(z)) * np.exp(z)
        nodes.append(z)
        mass.append(weight / weight.sum())
    one = torch.zeros(1, dtype=torch.float64)
    return Quadrature(
        names=NAMES,
        mean=torch.tensor([MEAN], dtype=torch.float64),
        sd=torch.tensor([SD], dtype=torch.float64),
        log_evidence=one,
        error=one,
        edge=one,
        converged=torch.ones(1, dtype=torch.bool),
        nodes=torch.from_numpy(np.array(nodes)).unsqueeze(0),
        mass=torch.from_numpy(np.array(mass)).unsqueeze(0),
    )


def draws(seed: int, chains: int = 8, count: int = 500) -> Posterior:
    """Exact and independent draws of the same."""
    rng = np.random.default_rng(seed)
    drawn = np.stack([law.rvs((chains, count, 1), random_state=rng) for law in laws()], -1)
    return Posterior(NAMES, torch.from_numpy(drawn), torch.ones(1, dtype=torch.bool))


def steps(ax, label: str) -> StepPatch:
    return next(p for p in ax.patches if isinstance(p, StepPatch) and p.get_label() == label)


def test_exact_curve_is_the_density() -> None:
    for name, law in zip(NAMES, laws(), strict=True):
        value, density = exact_density(quadrature(), name)
        assert np.allclose(density, law.pdf(value), rtol=0, atol=1e-6 * law.pdf(value).max())
        # the tails left out
        assert np.trapezoid(density, value) == pytest.approx(0.999, abs=1e-4)


@pytest.mark.statistical
def test_histograms_integrate_to_one_and_follow_the_density(rotating_seed: int, draws_factor: int) -> None:
    chains = 8 * draws_factor
    a, b = draws(rotating_seed, chains), draws(rotating_seed + 1, chains // 4)
    ax = axes()
    assert plots.marginals(ax, "T_L", a["T_L"], b["T_L"], quadrature(), truth=0.31) is ax
    law = laws()[0]
    for label, posterior in (("SGLD", a), ("NUTS", b)):
        height, edges, _ = steps(ax, label).get_data()
        assert (height * np.diff(edges)).sum() == pytest.approx(1.0, abs=1e-12)
        share, count = np.diff(law.cdf(edges)), posterior["T_L"].numel()
        found = height * np.diff(edges)
        # over some 40 bins; a count below a few draws is not normal, hence the 8 draws
        assert (np.abs(found - share) <= BAR * np.sqrt(share / count) + 8 / count).all()
    lines = {line.get_label(): float(np.asarray(line.get_xdata())[0]) for line in ax.lines}
    assert lines["truth"] == 0.31


def test_draws_that_ran_away_are_counted_and_do_not_squeeze_the_rest() -> None:
    drawn = draws(0)["T_L"].flatten().clone()
    drawn[:4], drawn[4:44] = 1e6, math.nan
    ax = plots.marginals(axes(), "T_L", drawn, None, quadrature())
    height, edges, _ = steps(ax, "SGLD").get_data()
    assert (height * np.diff(edges)).sum() == pytest.approx(1 - 40 / len(drawn))
    assert ax.get_xlim()[1] < 1.0


def test_marginals_without_quadrature() -> None:
    ax = plots.marginals(axes(), "K_L", draws(0)["K_L"], draws(1)["K_L"], None)
    low, high = ax.get_xlim()
    assert low < 0.8 < 1.2 < high


def test_a_cloud_shows_what_is_finite_of_each_method() -> None:
    clouds = {method: draws(seed).flat[:, 0, :2].numpy().copy() for seed, method in enumerate(("exact", "SGLD"))}
    clouds["SGLD"][:3] = math.nan
    ax = joint_cloud(axes(), clouds, truth=(0.3, 1.0))
    assert ax.get_legend_handles_labels()[1] == ["exact", "SGLD", "truth"]
    shown = [np.asarray(line.get_xydata()) for line in ax.lines if len(np.asarray(line.get_xydata())) > 1]
    assert [len(points) for points in shown] == [1500, 1500]
    assert all(np.isfinite(points).all() for points in shown)


def test_scatter_counts_what_is_within_and_shows_what_is_far() -> None:
    value = np.array([0.0, 0.09, -0.11, 0.5, math.nan, -9.0])
    converged = np.array([True, False, True, True, True, True])
    ax = agreement_scatter(
        axes(), np.geomspace(1e-3, 0.5, 6), value, limits=(-0.1, 0.1), error=np.full(6, 0.02), converged=converged
    )
    assert ax.get_title("left") == "33 % within"
    low, high = ax.get_ylim()
    y = np.concatenate([np.asarray(line.get_ydata(), float) for line in ax.lines if line.get_marker() in "oDv^"])
    assert len(y) == 6
    assert ((y > low) & (y < high)).all()
    assert high == pytest.approx(1.2)
    hollow = [line for line in ax.lines if line.get_fillstyle() == "none"]
    assert [list(np.asarray(line.get_ydata())) for line in hollow] == [[0.09]]
    assert ax.get_xlim()[0] < 0.1 < 50 < ax.get_xlim()[1]
