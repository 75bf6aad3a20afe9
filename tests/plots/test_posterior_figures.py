"""The figures of a validation, made of a small one."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from matplotlib.figure import Figure
from matplotlib.text import Text
from scipy.stats import kstest

from avtorch import plots
from avtorch.inference import Posterior, SamplerSettings, integrate
from avtorch.plots.posteriors import ChosenWindows
from avtorch.validation.agreement import AgreementVerdict, agreement, between
from avtorch.validation.reference import exact_draws
from avtorch.validation.stein import Stein
from avtorch.validation.validate import Validation
from avtorch.validation.windows import synthetic_windows

pytest.importorskip("arviz")
WINDOWS = 6
FILES = {"marginals.png", "joint.png", "ecdf.png", "agreement.png"}


@pytest.fixture(scope="module")
def validation() -> Validation:
    """Exact draws in the place of both samplers: the figures need draws, not a sampler."""
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
    shifted = dataclasses.replace(validation, sgld=dataclasses.replace(sgld, draws=draws))
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
    alone = dataclasses.replace(
        validation, quadrature=None, reference="nuts", compared=index, agreement=validation.sgld_nuts
    )
    figures = plots.validation_figures(alone)
    assert set(figures) == FILES - {"ecdf.png"}
    for make in figures.values():
        nothing_runs_out(make())
