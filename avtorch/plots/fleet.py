"""Drawings of a fleet: its cars by T_L and K_L, and their P(string stable) beside the target."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter, ScalarFormatter

from avtorch.plots.style import BLACK, BLUE, GREY, ORANGE, VERMILLION, panels_of, styled

FEW = 60
"""Cars that are drawn one by one, each with its intervals."""

NAMED = 8
"""Cars whose rank is written beside them."""

BINS = 30
"""Of the lag and of the gain, for more cars."""

LARGEST = 40.0
"""Area of the largest square [pt²]."""

Car = Mapping[str, Any]


def actuation_of_cars(ax: Axes, cars: Sequence[Car]) -> Axes:
    """T_L and K_L of each car with 90 % intervals; of many cars, squares whose area is their number."""
    known = [car for car in cars if car["T_L"] is not None and car["K_L"] is not None]
    points = np.array([[car["T_L"]["mean"], car["K_L"]["mean"]] for car in known]).reshape(-1, 2)
    spread = points[:, 0].max() / max(points[:, 0].min(), 1e-6) > 4
    if spread:
        ax.set_xscale("log")
        ax.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 3.0, 5.0)))
        ax.xaxis.set_major_formatter(ScalarFormatter())
        ax.xaxis.set_minor_formatter(NullFormatter())
    kinds = {"below target": (VERMILLION, "v"), "unlike siblings": (ORANGE, "D"), "changed": (ORANGE, "s")}
    told = [kinds.get(car["reason"], (BLUE, "o")) for car in known]
    if len(known) <= FEW:
        for (x, y), car, (colour, _) in zip(points, known, told, strict=True):
            ax.plot([car["T_L"]["q05"], car["T_L"]["q95"]], [y, y], color=colour, lw=1.0)
            ax.plot([x, x], [car["K_L"]["q05"], car["K_L"]["q95"]], color=colour, lw=1.0)
        for colour, marker in dict.fromkeys(told):
            these = points[[one == (colour, marker) for one in told]]
            ax.plot(these[:, 0], these[:, 1], ls="", marker=marker, color=colour, ms=5)
    else:
        _squares(ax, points, [colour for colour, _ in told], logarithmic=spread)
    first = [i for i, car in enumerate(known) if car["reason"] in kinds][:NAMED]
    for i in first if len(known) <= FEW else ():
        ax.annotate(str(known[i]["rank"]), points[i], xytext=(4, 4), textcoords="offset points", fontsize=9)
    ax.set(xlabel="actuation lag T_L [s]", ylabel="actuation gain K_L")
    return ax


def _squares(ax: Axes, points: np.ndarray, told: Sequence[str], *, logarithmic: bool) -> None:
    """A square in each bin with the area of its cars; within it one of those below the target, or else set apart."""
    x = np.log(points[:, 0]) if logarithmic else points[:, 0]
    edges = [np.linspace(values.min(), values.max() + 1e-9, BINS + 1) for values in (x, points[:, 1])]
    middle = [0.5 * (edge[1:] + edge[:-1]) for edge in edges]
    most = 0.0
    for colour in (BLUE, ORANGE, VERMILLION):
        # of all cars, then of the kind alone, on one scale
        which = np.array([colour in (BLUE, one) for one in told])
        counts, *_ = np.histogram2d(x[which], points[which, 1], bins=edges)
        most = max(most, counts.max())
        columns, rows = np.nonzero(counts)
        at = np.exp(middle[0][columns]) if logarithmic else middle[0][columns]
        size = np.maximum(2.0, LARGEST * counts[columns, rows] / most)
        ax.scatter(at, middle[1][rows], s=size, marker="s", color=colour, linewidths=0)


def stability_of_cars(ax: Axes, cars: Sequence[Car], target: float) -> Axes:
    """The share of cars up to each P(string stable), and the target."""
    stable = np.sort([car["p_string_stable"]["now"] for car in cars if car["p_string_stable"] is not None])
    share = 100 * np.arange(1, len(stable) + 1) / len(stable)
    ax.step([0.0, *stable, 1.0], [0.0, *share, 100.0], where="post", color=BLUE)
    if len(stable) <= FEW:
        below = stable < target
        for some, colour, marker in ((below, VERMILLION, "v"), (~below, BLUE, "o")):
            ax.plot(stable[some], share[some], ls="", marker=marker, color=colour, ms=5)
    ax.axvline(target, color=BLACK, lw=1.0, ls="--")
    ax.annotate(
        f"target {target:g}",
        (target, 97),
        xytext=(-4, 0),
        textcoords="offset points",
        ha="right",
        va="top",
        color=GREY,
        fontsize=9,
    )
    ax.set(xlabel="P(string stable)", ylabel="share of cars up to it [%]", xlim=(-0.03, 1.03), ylim=(0, 103))
    return ax


@styled
def fleet_figure(answer: Mapping[str, Any]) -> Figure:
    """Cars of a fleet's answer by T_L and K_L, beside their P(string stable)."""
    figure, (first, second) = panels_of(2, 3.6)
    actuation_of_cars(first, answer["cars"])
    stability_of_cars(second, answer["cars"], answer["target"])
    first.set_title("Actuation", loc="left")
    second.set_title("String stability", loc="left")
    return figure
