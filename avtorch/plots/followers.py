"""Drawings of several followers side by side: headway, lag with delay, string stability, how much each amplifies."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from avtorch.errors import InputError
from avtorch.follower import FollowerDiagnosis
from avtorch.plots.style import BLACK, BLUE, GREY, VERMILLION, styled

_MOST = 4.0  # of an axis of peak gains
_WORDS = {"headway_s": "headway [s]", "lag_with_delay_s": "lag with delay [s]"}


def parameter_of_each(ax: Axes, cars: Sequence[FollowerDiagnosis], name: str) -> Axes:
    """Mean and central 90 % of one of the `parameters`, a row a car. Raises `InputError` for a name no car has."""
    if not all(name in car.parameters for car in cars):
        raise InputError(f"name: found {name!r}, needs one of {', '.join(cars[0].parameters)}")
    rows = np.arange(len(cars))[::-1]
    estimates = [car.parameters[name] for car in cars]
    ax.hlines(rows, [q.q05 for q in estimates], [q.q95 for q in estimates], color=BLUE)
    ax.plot([q.mean for q in estimates], rows, "o", color=BLUE, ms=4)
    ax.set_yticks(rows, [car.name for car in cars])
    ax.set(xlabel=_WORDS.get(name, name.replace("_", " ")), ylim=(-0.6, len(cars) - 0.4))
    ax.set_xlim(left=0)
    return ax


def peak_gain_of_each(ax: Axes, cars: Sequence[FollowerDiagnosis]) -> Axes:
    """Peak gain at the median speed, a row a car; above 1 the leader's motion grows from car to car.

    Rows of cars whose loop may be unstable are left empty; gains above 4 are cut off.
    """
    rows = np.arange(len(cars))[::-1]
    for row, car in zip(rows, cars, strict=True):
        q = car.usual.peak_gain
        if q is None:
            continue
        colour = VERMILLION if car.usual.p_string_stable < 0.05 else BLACK if car.usual.p_string_stable < 0.95 else BLUE
        ax.hlines(row, q.q05, min(q.q95, _MOST), color=colour)
        ax.plot(min(q.mean, _MOST), row, "o", color=colour, ms=4)
    ax.axvline(1.0, color=GREY, lw=0.8)
    ax.set_yticks(rows, [car.name for car in cars])
    ax.set(xlabel="peak gain [-]", ylim=(-0.6, len(cars) - 0.4), xlim=(0.9, _MOST))
    return ax


@styled
def followers_figure(cars: Sequence[FollowerDiagnosis]) -> Figure:
    """Headway, lag with delay and peak gain of each car."""
    figure = Figure(figsize=(11, 1.2 + 0.3 * len(cars)), layout="constrained")
    axes = figure.subplots(1, 3, sharey=True)
    parameter_of_each(axes[0], cars, "headway_s")
    parameter_of_each(axes[1], cars, "lag_with_delay_s")
    peak_gain_of_each(axes[2], cars)
    return figure
