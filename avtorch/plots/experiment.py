"""Drawings of the experiment to drive next."""

from __future__ import annotations

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from avtorch.experiment import Experiment, Manoeuvre
from avtorch.plots.style import BLUE, GREY, ORANGE, styled


def commands(ax: Axes, m: Manoeuvre) -> Axes:
    """The command over time, held between rows."""
    ax.axhline(0.0, color=GREY, lw=0.6)
    ax.step(m.time, m.command, where="post", color=BLUE)
    ax.set(ylabel="command [m/s²]")
    ax.margins(x=0)
    return ax


def expected_speed(ax: Axes, m: Manoeuvre) -> Axes:
    """The speed that the most probable hypothesis predicts."""
    ax.plot(m.time, m.speed, color=ORANGE)
    ax.set(xlabel="time [s]", ylabel="expected speed [m/s]", ylim=(0, 1.15 * float(m.speed.max())))
    ax.margins(x=0)
    return ax


@styled
def experiment_figure(experiment: Experiment, *, narrow: bool = False) -> Figure:
    """Command over speed, on one time axis; `narrow`: for a phone."""
    figure = Figure(figsize=(4.0, 4.2) if narrow else (8.6, 4.0), layout="constrained")
    top, bottom = figure.subplots(2, 1, sharex=True)
    commands(top, experiment.manoeuvre)
    expected_speed(bottom, experiment.manoeuvre)
    top.set_title(experiment.manoeuvre.name, loc="left")
    return figure
