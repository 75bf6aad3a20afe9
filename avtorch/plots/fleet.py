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

Car = Mapping[str, Any]


def actuation_of_cars(ax: Axes, cars: Sequence[Car]) -> Axes:
    """T_L and K_L of each car, of few cars with 90 % intervals."""
    known = [car for car in cars if car["T_L"] is not None and car["K_L"] is not None]
    points = np.array([[car["T_L"]["mean"], car["K_L"]["mean"]] for car in known]).reshape(-1, 2)
    if points[:, 0].max() / max(points[:, 0].min(), 1e-6) > 4:
        ax.set_xscale("log")
        ax.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 3.0, 5.0)))
        ax.xaxis.set_major_formatter(ScalarFormatter())
        ax.xaxis.set_minor_formatter(NullFormatter())
    kinds = {"below target": (VERMILLION, "v"), "unlike siblings": (ORANGE, "D"), "changed": (ORANGE, "s")}
    told = [kinds.get(car["reason"], (BLUE, "o")) for car in known]
    few = len(known) <= FEW
    for (x, y), car, (colour, _) in zip(points, known, told, strict=True) if few else ():
        ax.plot([car["T_L"]["q05"], car["T_L"]["q95"]], [y, y], color=colour, lw=1.0)
        ax.plot([x, x], [car["K_L"]["q05"], car["K_L"]["q95"]], color=colour, lw=1.0)
    # the most telling kind last, above the others; thousands of dots are an image within the page
    for colour, marker in ((BLUE, "o"), *reversed(kinds.values())):
        these = points[[one == (colour, marker) for one in told]]
        ax.plot(these[:, 0], these[:, 1], ls="", marker=marker, color=colour, ms=5 if few else 3, rasterized=not few)
    first = [i for i, car in enumerate(known) if car["reason"] in kinds][:NAMED]
    for i in first if few else ():
        ax.annotate(str(known[i]["rank"]), points[i], (4, 4), textcoords="offset points", fontsize=9)
    ax.set(xlabel="actuation lag T_L [s]", ylabel="actuation gain K_L")
    return ax


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
    look: Any = {"textcoords": "offset points", "ha": "right", "va": "top", "color": GREY, "fontsize": 9}
    ax.annotate(f"target {target:g}", (target, 97), (-4, 0), **look)
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
