"""Drawings of posteriors, and the figures of a small validation: the numbers that they show are the right ones."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from matplotlib.figure import Figure
from matplotlib.patches import StepPatch
from matplotlib.text import Text
from scipy.stats import gamma, kstest

from avtorch import plots
from avtorch.inference import Posterior, Quadrature, SamplerSettings, integrate
from avtorch.plots.posteriors import ChosenWindows, agreement_reach, agreement_scatter, exact_density, joint_cloud
from avtorch.validation.agreement import AgreementVerdict, agreement, between
from avtorch.validation.reference import exact_draws
from avtorch.validation.stein import Stein
from avtorch.validation.validate import Validation
from avtorch.validation.windows import synthetic_windows
from tests.bars import BAR

NAMES = ("T_L", "K_L", "sigma")
MEAN, SD = (0.3, 1.0, 0.1), (0.06, 0.1, 0.01)
WINDOWS = 6
FILES = {"marginals.png", "joint.png", "ecdf.png", "agreement.png"}


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
        axes(),
        np.geomspace(1e-3, 0.5, 6),
        value,
        limits=(-0.1, 0.1),
        error=np.full(6, 0.02),
        converged=converged,
        reach=agreement_reach(value, (-0.1, 0.1)),
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


# figures of a validation
@pytest.fixture(scope="module")
def validation() -> Validation:
    """Exact draws in the place of both samplers: the figures need draws, not a sampler."""
    pytest.importorskip("arviz")
    windows = synthetic_windows(WINDOWS, seed=3)
    exact = integrate(windows.density, nodes=33)
    generator = torch.Generator().manual_seed(0)
    sgld = exact_draws(windows.density, chains=16, draws=60, generator=generator)
    index = torch.tensor([0, 2, 3, 5])
    drawn = exact_draws(windows.density, chains=2, draws=200, generator=generator)
    nuts = Posterior(drawn.names, drawn.draws[:, :, index], drawn.converged[index])
    own = Posterior(sgld.names, sgld.draws[:, :, index], sgld.converged[index])
    nothing = torch.zeros(WINDOWS, dtype=torch.float64)
    return Validation(
        windows=windows,
        settings=SamplerSettings(),
        seed=0,
        reference="quadrature",
        sgld=sgld,
        quadrature=exact,
        nuts=nuts,
        nuts_index=index,
        compared=torch.arange(WINDOWS),
        agreement=agreement(sgld, exact),
        nuts_agreement=None,
        sgld_nuts=between(own, nuts),
        stein=Stein(nothing, nothing, nothing, points=0),
        seconds={},
        verdict=AgreementVerdict(True, 1.0, 0.54, 1.0, 0.9, 0.5, "a test"),
    )


def nothing_runs_out(figure: Figure) -> None:
    figure.canvas.draw()
    for legend in figure.legends:
        box = legend.get_window_extent()
        assert box.x0 >= -1, "the legend runs out of the picture"
        assert box.x1 <= figure.bbox.x1 + 1, "the legend runs out of the picture"
    headings = {figure.get_suptitle(), *(ax.get_title("left") for ax in figure.axes)} - {""}
    for text in figure.findobj(lambda artist: isinstance(artist, Text) and artist.get_text() in headings):
        box = text.get_window_extent()
        assert box.x0 >= -2, text
        assert box.x1 <= figure.bbox.x1 + 2, text


@pytest.mark.slow
def test_figures_of_a_validation(validation: Validation) -> None:
    figures = plots.validation_figures(validation)
    assert set(figures) == FILES
    for make in figures.values():
        nothing_runs_out(make())


@pytest.mark.slow
def test_windows_shown_go_from_wide_to_narrow(validation: Validation) -> None:
    figure = plots.validation_figures(validation)["joint.png"]()
    titles = [ax.get_title("left").split("\n") for ax in figure.axes]
    assert [t[0].split(":")[0] for t in titles] == ["wide", "middle", "narrow"]
    shown = [int(t[0].split("window ")[1].split(",")[0]) for t in titles]
    assert set(shown) <= set(validation.nuts_index.tolist())
    assert validation.quadrature is not None
    width = (validation.quadrature.sd / validation.quadrature.mean)[shown, 0]
    assert width.tolist() == sorted(width.tolist(), reverse=True)


def test_exact_probabilities_are_uniform_and_show_a_shift(validation: Validation) -> None:
    sgld = validation.sgld
    draws = sgld.draws.clone()
    draws[..., 1] += 0.5 * sgld.sd[:, 1]
    shifted = replace(validation, sgld=replace(sgld, draws=draws))
    p_values = [
        [kstest(ChosenWindows(found).exact_probabilities(0, i)["SGLD"], "uniform").pvalue for i in range(3)]
        for found in (validation, shifted)
    ]
    assert min(p_values[0]) > 1e-3
    assert p_values[1][0] == p_values[0][0]
    assert p_values[1][1] < 1e-9


@pytest.mark.slow
def test_without_quadrature_nuts_is_the_reference(validation: Validation) -> None:
    index = validation.nuts_index
    alone = replace(validation, quadrature=None, reference="nuts", compared=index, agreement=validation.sgld_nuts)
    figures = plots.validation_figures(alone)
    assert set(figures) == FILES - {"ecdf.png"}
    for make in figures.values():
        nothing_runs_out(make())
