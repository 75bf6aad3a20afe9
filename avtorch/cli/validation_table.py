"""The table of a validation, to read in ten seconds."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rich.markup import escape
from rich.table import Table


def validation_table(answer: Mapping[str, Any]) -> Table:
    """One row per parameter: distance of SGLD from the reference over the windows; the last row has the aims."""
    from avtorch.inference.units import shown_unit

    summary = answer["summary"]
    table = Table(box=None, header_style="bold", pad_edge=False, padding=(0, 2, 0, 0))
    for name in ("", "mean error [SD]", "SD ratio", "W1 [SD]", "90 % covers", "exact", "ESS"):
        table.add_column(escape(name), justify="right" if name else "left", no_wrap=True)
    exact = summary.get("coverage_90_quadrature")
    for key in ("T_L", "K_L", "sigma"):
        name = summary["sigma_is"] if key == "sigma" else key
        table.add_row(
            escape(f"{name} [{shown_unit(name)}]"),
            f"{summary['mean_difference_sd_p95'][key]:.3f}",
            f"{summary['sd_ratio_p025'][key]:.3f}-{summary['sd_ratio_p975'][key]:.3f}",
            f"{summary['w1_sd_p95'][key]:.3f}",
            f"{100 * summary['coverage_90'][key]:.1f} %",
            "" if exact is None else f"{100 * exact[key]:.1f} %",
            f"{summary['ess_bulk_median'][key]:.0f}",
        )
    table.add_row("aim", "0.100", "0.950-1.050", "", "", "", "", style="dim")
    return table


def validation_notes(answer: Mapping[str, Any]) -> list[str]:
    """A caption: the columns, the number of windows they are over, and the time per window."""
    summary = answer["summary"]
    seconds = summary["seconds_per_window"]
    run = [f"{name} {seconds[name]:.2g} s" for name in seconds if name not in summary["not_run"]]
    covers = "interval covers the truth" if summary["coverage_is"] == "truth" else "interval's mass in the reference"
    compared = summary["compared"]
    return [
        f"SGLD against {answer['reference']}, {compared} windows: errors and W1 are 95 % quantiles, SD ratios "
        f"the central 95 %; 90 % {covers}.",
        f"{summary['windows']} windows, {summary['excited']} excited, {summary['settled']} converged; "
        f"one takes {', '.join(run)}.",
    ]
