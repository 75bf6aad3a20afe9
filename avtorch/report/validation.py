"""The page of a validation: does SGLD agree with exact quadrature and with NUTS?"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from scipy.stats import kstest

from avtorch.inference.arviz_export import shown_unit
from avtorch.plots.posteriors import ChosenWindows, validation_figures
from avtorch.report.page import Origin, Page, Section, picture_of
from avtorch.report.table import Table
from avtorch.results import validation_answer
from avtorch.validation.agreement import MEAN_TOLERANCE, SD_TOLERANCE
from avtorch.validation.validate import Validation

_MOST = 40  # rows of the table behind a picture of all windows
_REFERENCES = {"nuts": "NUTS", "quadrature": "exact quadrature"}


def validation_html(found: Validation, *, origin: Origin | None = None) -> str:
    """The page of a validation as text. Its clouds of draws are images within the page."""
    answer = validation_answer(found)
    summary = answer["summary"]
    against = _REFERENCES[answer["reference"]]
    word = "agree" if found.verdict.agree else "disagree"
    page = Page(
        "Validation",
        f"{answer['source']} · {summary['windows']} windows",
        Section(
            f"SGLD and {against} {word}",
            (answer["why"],),
            tables=(validation_table(answer),),
            items=validation_notes(answer),
        ),
        _sections(found),
        "green" if found.verdict.agree else "amber",
    )
    return page.html(origin)


def _sections(found: Validation) -> list[Section]:
    """A picture each, with its table; the exact probabilities only where there is quadrature."""
    figures = validation_figures(found)
    chosen = ChosenWindows(found)
    parts = {
        "agreement": ("Window by window", _windows),
        "marginals": ("Marginals", _marginals),
        "joint": ("Lag and gain together", _correlations),
        "ecdf": ("Exact probabilities below the draws", _ecdfs),
    }
    return [
        Section(title, pictures=(picture_of(name, figures[f"{name}.png"](), table(chosen)),))
        for name, (title, table) in parts.items()
        if f"{name}.png" in figures
    ]


def validation_table(answer: Mapping[str, Any]) -> Table:
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


def validation_notes(answer: Mapping[str, Any]) -> tuple[str, ...]:
    """What the columns are, the number of windows they are over, and the time per window."""
    summary, against = answer["summary"], _REFERENCES[answer["reference"]]
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


# behind the pictures ------------------------------------------------------------------------------------------------
def _windows(chosen: ChosenWindows) -> Table:
    """The windows farthest from the reference first, `_MOST` of them at most."""
    found = chosen.validation
    columns = ("window", *(f"{what}, {n}" for what in ("mean error [SD]", "SD ratio") for n in found.names))
    errors, ratios = (x.numpy() for x in (found.agreement.mean_difference, found.agreement.sd_ratio))
    far = np.nan_to_num(np.maximum(abs(errors) / MEAN_TOLERANCE, abs(ratios - 1) / SD_TOLERANCE), nan=np.inf).max(1)
    rows = tuple(
        (str(int(found.compared[i])), *(f"{x:+.3f}" for x in errors[i]), *(f"{x:.3f}" for x in ratios[i]))
        for i in np.argsort(-far, kind="stable")[:_MOST]
    )
    some = f"{len(rows)} of {len(errors)} windows" if len(rows) < len(errors) else "Windows"
    return Table(f"{some}, the farthest from the reference first", columns, rows, numeric=columns[1:])


def _marginals(chosen: ChosenWindows) -> Table:
    found = chosen.validation
    rows = []
    for window in chosen.windows:
        for i, name in enumerate(found.names):
            exact, truth = found.quadrature, chosen.truth(window, name)
            sides = (
                None if exact is None else (exact.mean[window.number, i], exact.sd[window.number, i]),
                (found.sgld.mean[window.number, i], found.sgld.sd[window.number, i]),
                None if window.nuts is None else (found.nuts.mean[window.nuts, i], found.nuts.sd[window.nuts, i]),
            )
            told = ("" if side is None else f"{float(side[0]):.4g} ± {float(side[1]):.2g}" for side in sides)
            rows.append(
                (f"{window.number}: {name} [{shown_unit(name)}]", *told, "" if truth is None else f"{truth:.4g}")
            )
    columns = ("window and parameter", "exact", "SGLD", "NUTS", "truth")
    return Table("Mean and SD", columns, tuple(rows))


def _correlations(chosen: ChosenWindows) -> Table:
    """Of T_L and K_L, by the draws."""
    pair = [chosen.validation.names.index(name) for name in ("T_L", "K_L")]
    columns = ("window", "exact", "SGLD", "NUTS")
    rows = []
    for row, window in enumerate(chosen.windows):
        told = {m: f"{np.corrcoef(x[:, pair].numpy().T)[0, 1]:+.2f}" for m, x in chosen.draws(row).items()}
        rows.append((str(window.number), *(told.get(method, "") for method in columns[1:])))
    return Table("Correlation of lag and gain", columns, tuple(rows), numeric=columns[1:])


def _ecdfs(chosen: ChosenWindows) -> Table:
    rows = []
    for row, window in enumerate(chosen.windows):
        for i, name in enumerate(chosen.validation.names):
            tests = {method: kstest(x, "uniform") for method, x in chosen.exact_probabilities(row, i).items()}
            for method, test in tests.items():
                rows.append((f"{window.number}: {name}, {method}", f"{test.statistic:.3f}", f"{test.pvalue:.2g}"))
    columns = ("window, parameter and method", "farthest from uniform", "p-value")
    return Table("Distance from uniform (Kolmogorov-Smirnov)", columns, tuple(rows), numeric=columns[1:])
