"""Drawings of single manoeuvres: the command, what the car did, and what the simulator does."""

from __future__ import annotations

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from avtorch.gap.result.manoeuvres import Manoeuvre
from avtorch.gap.result.traces import Traces
from avtorch.plots.style import BLACK, BLUE, GREY, VERMILLION, styled

_COLOURS = {"command": GREY, "measured": BLACK, "baseline simulator": VERMILLION, "with what was named": BLUE}


def manoeuvre_lines(ax: Axes, manoeuvre: Manoeuvre, traces: Traces) -> Axes:
    """The accelerations of one manoeuvre over time, which is that of its log.

    Example:
        >>> import numpy as np
        >>> from matplotlib.figure import Figure
        >>> from avtorch.gap.result.manoeuvres import manoeuvres
        >>> from avtorch.gap.result.traces import Traces
        >>> from avtorch.plots.manoeuvres import manoeuvre_lines
        >>> time = np.arange(0.0, 30.0, 0.05)
        >>> u = np.where((time > 10) & (time < 15), -2.0, 0.0)
        >>> traces = Traces(time, u, ("accel",), 0.9 * u[None], u[None], u[None], u, np.zeros(600, int))
        >>> len(manoeuvre_lines(Figure().subplots(), manoeuvres(traces)[0], traces).lines)
        4
    """
    time = traces.time[manoeuvre.rows]
    for label, values in manoeuvre.lines.items():
        ax.plot(time, values, color=_COLOURS[label], lw=1.2, label=label)
    ax.set(xlabel="time [s]", ylabel="acceleration [m/s²]")
    ax.margins(x=0)
    return ax


@styled
def manoeuvre_figure(manoeuvre: Manoeuvre, traces: Traces) -> Figure:
    """One manoeuvre, as wide as a phone or half a desk's page."""
    figure = Figure(figsize=(4.0, 2.7), layout="constrained")
    ax = manoeuvre_lines(figure.add_subplot(), manoeuvre, traces)
    figure.legend(*ax.get_legend_handles_labels(), loc="outside upper left", ncols=2, fontsize=8)
    return figure
