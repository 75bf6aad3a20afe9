"""The page of a validation: does SGLD agree with exact quadrature and with NUTS?"""

from __future__ import annotations

from collections.abc import Mapping
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

from avtorch.inference.units import shown_unit
from avtorch.plots.posterior_figures import validation_figures
from avtorch.report.answer_page import AnswerPage, Section, answer_html, written
from avtorch.report.origin import Origin
from avtorch.report.picture import Picture, picture_of
from avtorch.report.table import Table
from avtorch.report.validation_tables import tables_behind
from avtorch.results import validation_answer

if TYPE_CHECKING:
    from avtorch.validation import Validation

_TITLES = {
    "agreement": "Window by window",
    "marginals": "Marginals",
    "joint": "Lag and gain together",
    "ranks": "Ranks",
    "ecdf": "Exact probabilities below the draws",
}
"""Of the sections, by picture, in their order."""
_SAYS = {
    "agreement": "Dots, one a window: how far SGLD's mean and SD are from the reference's, over the width of the "
    "posterior, with the limits asked for.",
    "marginals": "Exact densities of each parameter with histograms of the draws of SGLD and of NUTS.",
    "joint": "Clouds of SGLD's draws of lag and gain within the 50 and 90 % regions of the references.",
    "ranks": "Bars of the ranks of groups of chains in the pool of all draws, within the band that chance explains.",
    "ecdf": "Lines, one a window: the share of draws below each exact probability, less what it should be, with the "
    "band that chance explains.",
}


def validation_html(found: Validation, *, origin: Origin | None = None) -> str:
    """The page of a validation as text. Its clouds of draws are images within the page.

    Example:
        >>> from avtorch.inference import SamplerSettings
        >>> from avtorch.report import validation_html
        >>> from avtorch.validation import NutsSettings, synthetic_windows, validate
        >>> quick = dict(settings=SamplerSettings(chains=64), nuts=NutsSettings(1, 20, 10), nuts_windows=1)
        >>> "SGLD and exact quadrature" in validation_html(validate(synthetic_windows(1, seed=1), **quick))
        True
    """
    answer = validation_answer(found)
    summary = answer["summary"]
    against = {"nuts": "NUTS", "quadrature": "exact quadrature"}[answer["reference"]]
    word = "agree" if found.verdict.agree else "disagree"
    table = _table(answer)
    page = AnswerPage(
        "Validation",
        f"{answer['source']} · {summary['windows']} windows",
        Section(f"SGLD and {against} {word}", (answer["why"],), tables=(table,), items=_legend(answer, against)),
        tuple(Section(_TITLES[name], pictures=(picture,)) for name, picture in _pictures(found).items()),
        "green" if found.verdict.agree else "amber",
    )
    return answer_html(page, origin=origin)


def write_validation_page(found: Validation, folder: str | PathLike[str], *, origin: Origin | None = None) -> Path:
    """Write `validation.html` into `folder`; returns its path. Raises `InputError` where it cannot be written.

    Example:
        >>> from avtorch.inference import SamplerSettings
        >>> from avtorch.report import write_validation_page
        >>> from avtorch.validation import NutsSettings, synthetic_windows, validate
        >>> quick = dict(settings=SamplerSettings(chains=64), nuts=NutsSettings(1, 20, 10), nuts_windows=1)
        >>> write_validation_page(validate(synthetic_windows(1, seed=1), **quick), "out").name
        'validation.html'
    """
    return written(validation_html(found, origin=origin), folder, "validation.html")


def _pictures(found: Validation) -> dict[str, Picture]:
    by_width = {narrow: validation_figures(found, narrow=narrow) for narrow in (False, True)}
    tables = tables_behind(found)
    return {
        name: picture_of(
            name,
            lambda narrow, name=name: by_width[narrow][f"{name}.png"](),
            _SAYS[name],
            tables[name],
        )
        for name in _TITLES
        if f"{name}.png" in by_width[False]
    }


def _table(answer: Mapping[str, Any]) -> Table:
    """A row a parameter: distance of SGLD from the reference over the windows; the last row has the aims."""
    summary = answer["summary"]
    exact = summary.get("coverage_90_quadrature")
    columns = ["parameter", "mean error [SD]", "SD ratio", "W1 [SD]", "90 % covers", "ESS"]
    if exact is not None:
        columns.insert(5, "exact covers")
    rows = []
    for key in ("T_L", "K_L", "sigma"):
        name = summary["sigma_is"] if key == "sigma" else key
        cells = [
            f"{name} [{shown_unit(name)}]",
            f"{summary['mean_difference_sd_p95'][key]:.3f}",
            f"{summary['sd_ratio_p025'][key]:.3f} to {summary['sd_ratio_p975'][key]:.3f}",
            f"{summary['w1_sd_p95'][key]:.3f}",
            f"{100 * summary['coverage_90'][key]:.1f} %",
            f"{summary['ess_bulk_median'][key]:.0f}",
        ]
        if exact is not None:
            cells.insert(5, f"{100 * exact[key]:.1f} %")
        rows.append(tuple(cells))
    rows.append(("aim", "0.100", "0.950 to 1.050", *("" for _ in columns[3:])))
    return Table("SGLD against the reference", tuple(columns), tuple(rows), numeric=tuple(columns[1:]))


def _legend(answer: Mapping[str, Any], against: str) -> tuple[str, ...]:
    summary = answer["summary"]
    seconds = summary["seconds_per_window"]
    run = ", ".join(f"{name} {seconds[name]:.2g} s" for name in seconds if name not in summary["not_run"])
    truth = summary["coverage_is"] == "truth"
    covers = "the share of windows whose interval covers the truth" if truth else "the interval's mass in the reference"
    return (
        f"Over {summary['compared']} windows against {against}: mean error and W1 (Wasserstein-1 distance) are 95 % "
        f"quantiles, SD ratios the central 95 %; “90 % covers” is {covers}; ESS: effective sample size, the median.",
        f"{summary['windows']} windows, {summary['excited']} excited, {summary['settled']} converged; one takes {run}.",
        "Each window is estimated alone, under the first prior.",
    )
