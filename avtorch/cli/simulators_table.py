"""The table of two simulators: their errors, what they are made of, and what each difference is worth."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from rich.markup import escape
from rich.table import Table

if TYPE_CHECKING:
    from avtorch.external import SimulatorComparison
    from avtorch.gap.quantity import Quantity

_ERRORS = {
    "rollout_rmse_accel": "acceleration error, {horizon} s [m/s²]",
    "rollout_rmse_speed": "speed error, {horizon} s [m/s]",
}


def simulators_table(found: SimulatorComparison) -> Table:
    """Rows of errors with their ratio, then rows of differences with what they do to the farther one's error."""
    table = Table(box=None, header_style="bold", pad_edge=False, padding=(0, 2, 0, 0))
    table.add_column("")
    for name in ("first", "second", "second / first (90 %)"):
        table.add_column(name, justify="right", no_wrap=True)
    for metric, e in found.errors.items():
        label = _ERRORS[metric].format(horizon=f"{found.horizon_s:.3g}")
        table.add_row(escape(label), f"{e.first.mean:.3g}", f"{e.second.mean:.3g}", _ratio(e.ratio))
    table.add_row("both, geometric mean", "", "", _ratio(found.ratio))
    if found.differences:
        table.add_row()
        table.add_row(*(f"[bold]{x}[/bold]" for x in ("difference", "first", "second", "error of the farther (90 %)")))
    for difference in found.differences:
        together = len(difference.parts) > 1
        sides = ("", "") if together else (_side(difference.first), _side(difference.second))
        table.add_row(escape(", ".join(difference.parts)), *sides, f"x {_ratio(difference.ratio)}")
    return table


def _ratio(q: Quantity) -> str:
    return f"{q.mean:.2f} ({q.q05:.2f} to {q.q95:.2f})"


def _side(values: Mapping[str, float] | None) -> str:
    from avtorch.gap.quantity import unit_of

    if values is None:
        return "none"
    units = {key: unit_of(key) for key in values}
    return ", ".join(f"{x:.3g}" + ("" if units[key] == "-" else f" {units[key]}") for key, x in values.items())
