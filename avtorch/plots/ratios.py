"""Ratios with their intervals beside one: what has changed, which of two is nearer."""

from __future__ import annotations

from collections.abc import Mapping

from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullLocator

from avtorch.gap.quantity import Quantity
from avtorch.plots.style import BLACK, BLUE, GREY, panels_of, styled


@styled
def ratio_figure(ratios: Mapping[str, Quantity], what: str = "ratio") -> Figure:
    """A dot and its central 90 % for each of `ratios`, blue where one lies outside, under the label `what`.

    Example:
        >>> from avtorch.gap.quantity import Quantity
        >>> from avtorch.plots import ratio_figure
        >>> len(ratio_figure({"lag T_L [s]": Quantity(1.5, 0.1, 1.3, 1.7)}, "after / before").axes)
        1
    """
    figure, (ax,) = panels_of(1, 0.9 + 0.5 * len(ratios))
    for row, q in enumerate(ratios.values()):
        colour = GREY if q.q05 <= 1 <= q.q95 else BLUE
        ax.plot([q.q05, q.q95], [row, row], color=colour, linewidth=2.5)
        ax.plot(q.mean, row, marker="o", markersize=8, color=colour)
        ax.annotate(f"{q.mean:.3g}", (q.mean, row), (0, 8), textcoords="offset points", ha="center", fontsize=9)
    ax.axvline(1.0, color=BLACK, linestyle="--", linewidth=1.1, zorder=1)
    ax.set_yticks(range(len(ratios)), list(ratios))
    ax.set_ylim(len(ratios) - 0.5, -0.7)
    ax.set_xscale("log")
    ends = [1.0, *(end for q in ratios.values() for end in (q.q05, q.q95) if end > 0)]
    low, high = min(*ends, 0.9), max(*ends, 1.1)
    pad = (high / low) ** 0.05
    ax.set_xlim(low / pad, high * pad)
    # decades are too far apart for ratios near one, even steps too close for ratios of a hundred
    even = high / low < 8
    ax.xaxis.set_major_locator(MaxNLocator(8) if even else LogLocator(10, (1, 2, 5), numticks=20))
    ax.xaxis.set_minor_locator(NullLocator())
    ax.xaxis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:.3g}"))
    ax.grid(False, axis="y")
    ax.set_xlabel(what)
    return figure
