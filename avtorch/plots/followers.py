"""Drawings of several followers side by side: headway, lag with delay, string stability, how much each amplifies."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from avtorch.follower import FollowerDiagnosis
from avtorch.plots.style import BLACK, BLUE, GREY, VERMILLION, styled

_MOST = 4.0  # of an axis of peak gains
_WORDS = {"headway_s": "headway [s]", "lag_with_delay_s": "lag with delay [s]"}


@styled
def followers_figure(cars: Sequence[FollowerDiagnosis]) -> Figure:
    """Headway, lag with delay and peak gain at the median speed, each with its central 90 %; a row a car.

    Above a gain of 1 the leader's motion grows from car to car. Cars whose loop may be unstable have none; gains above
    4 are cut off.
    """
    figure = Figure(figsize=(11, 1.2 + 0.3 * len(cars)), layout="constrained")
    axes = figure.subplots(1, 3, sharey=True)
    rows = np.arange(len(cars))[::-1]
    for ax, (name, words) in zip(axes, _WORDS.items(), strict=False):
        estimates = [car.parameters[name] for car in cars]
        ax.hlines(rows, [q.q05 for q in estimates], [q.q95 for q in estimates], color=BLUE)
        ax.plot([q.mean for q in estimates], rows, "o", color=BLUE, ms=4)
        ax.set_xlabel(words)
        ax.set_xlim(left=0)
    for row, car in zip(rows, cars, strict=True):
        stable, q = car.usual.p_string_stable, car.usual.peak_gain
        if q is not None:
            colour = VERMILLION if stable < 0.05 else BLACK if stable < 0.95 else BLUE
            axes[2].hlines(row, q.q05, min(q.q95, _MOST), color=colour)
            axes[2].plot(min(q.mean, _MOST), row, "o", color=colour, ms=4)
    axes[2].axvline(1.0, color=GREY, lw=0.8)
    axes[2].set(xlabel="peak gain [-]", xlim=(0.9, _MOST))
    axes[0].set_yticks(rows, [car.name for car in cars])
    axes[0].set_ylim(-0.6, len(cars) - 0.4)
    return figure
