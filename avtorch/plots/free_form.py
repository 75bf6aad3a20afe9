"""A drawing of what a repaired simulator carries without a name: its force map, and its resistance over speed."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from avtorch.arrays import BoolArray, FloatArray
from avtorch.errors import InputError
from avtorch.plots.style import BLACK, BLUE, GREY, styled

if TYPE_CHECKING:
    from avtorch.gap.result.diagnosis import Diagnosis

_CELLS = 24  # a side of the map


def force_contours(ax: Axes, found: Diagnosis) -> Axes:
    """Force beyond K u [m/s²] of the force map over speed and command; hatched, what was not driven: there only its
    smoothness speaks, and far from the drive it goes back to K u. Raises `InputError` without a force map."""
    form = found.free_form
    if form is None or not form.sizes.table > 0:
        raise InputError("free_form: the repaired simulator has no force map to draw")
    u, v, table = form.knots_u, form.knots_v, form.at.table
    most = max(float(np.abs(table).max()), 1e-6)
    drawn = ax.contourf(v, u, table, levels=np.linspace(-most, most, 13), cmap="RdBu_r")
    ax.figure.colorbar(drawn, ax=ax, label="force beyond K u [m/s²]", format="%.2g")
    across, along, driven = driven_cells(found)
    # contourf takes values in the middle of cells
    middle = [0.5 * (x[1:] + x[:-1]) for x in (across, along)]
    ax.contourf(*middle, (~driven).T.astype(float), levels=[0.5, 1.5], colors="none", hatches=["////"])
    ax.axhline(0.0, color=GREY, lw=0.8)
    ax.set(xlabel="speed [m/s]", ylabel="command [m/s²]", xlim=(v[0], v[-1]), ylim=(u[0], u[-1]))
    ax.grid(visible=False)
    return ax


def resistance_line(ax: Axes, found: Diagnosis) -> Axes:
    """The resistance of the free form [m/s²] over speed, and where the middle nine tenths of the drive lie.

    Raises `InputError` without a resistance.
    """
    form = found.free_form
    if form is None or not form.sizes.resistance > 0:
        raise InputError("free_form: the repaired simulator has no resistance to draw")
    ax.plot(form.knots_v, form.at.curve, color=BLUE, marker=".")
    speed = None if found.traces is None else found.traces.speed
    if speed is not None:
        low, high = np.quantile(speed, (0.05, 0.95))
        ax.axvspan(float(low), float(high), color=GREY, alpha=0.15, lw=0)
    ax.axhline(0.0, color=BLACK, lw=0.8)
    ax.set(xlabel="speed [m/s]", ylabel="acceleration [m/s²]")
    return ax


def driven_cells(found: Diagnosis) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Edges of cells in speed [m/s] and command [m/s²], and whether the drive was in each (speed, command)."""
    form, traces = found.free_form, found.traces
    assert form is not None
    edges = [np.linspace(x[0], x[-1], _CELLS + 1) for x in (form.knots_v, form.knots_u)]
    if traces is None or traces.speed is None:
        return edges[0], edges[1], np.ones((_CELLS, _CELLS), bool)
    counts = np.histogram2d(traces.speed, traces.command, bins=edges)[0]
    return edges[0], edges[1], counts > 0


@styled
def free_form_figure(found: Diagnosis, *, narrow: bool = False) -> Figure:
    """What the repaired simulator carries without a name, a panel for the map and one for the resistance.

    Raises `InputError` where it carries nothing.
    """
    form = found.free_form
    if form is None:
        raise InputError("free_form: the repaired simulator carries nothing without a name")
    panels = [
        draw
        for draw, size in ((force_contours, form.sizes.table), (resistance_line, form.sizes.resistance))
        if size > 0
    ]
    count = len(panels)
    size = (4.0, 0.4 + 3.0 * count) if narrow else (4.3 * count, 3.3)
    figure = Figure(figsize=size, layout="constrained")
    axes = figure.subplots(*((count, 1) if narrow else (1, count)), squeeze=False).ravel()
    for ax, draw in zip(axes, panels, strict=True):
        draw(ax, found)
    return figure
