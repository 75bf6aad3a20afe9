"""Operating curves of detectors: delay against false alarms."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from avtorch.errors import InputError
from avtorch.plots.style import BLACK, BLUE, GREEN, GREY, ORANGE, PURPLE, SKY, VERMILLION, styled

Point = tuple[float, float, float]
_COLOURS = (BLACK, BLUE, VERMILLION, ORANGE, PURPLE, SKY, GREEN, GREY)
_MARKS = "os^vDPX*"


def operating_curve(ax: Axes, curves: Mapping[str, Sequence[Point]]) -> Axes:
    """Plot the median delay [s] over the share of unchanged runs alarmed, one line per detector.

    ``curves`` by name hold ``(threshold, share alarmed, median delay [s])``. Down and left is better; points without a
    finite delay (fewer than half found) are left out.

    Raises:
        InputError: where there is no curve.
    """
    if not curves:
        raise InputError("curves: found none, needs one or more")
    for k, (name, points) in enumerate(curves.items()):
        finite = [(share, delay) for _, share, delay in points if math.isfinite(delay)]
        if not finite:
            continue
        x, y = zip(*finite, strict=True)
        ax.plot(
            x, y, color=_COLOURS[k % 8], marker=_MARKS[k % 8], markersize=4, linewidth=1, label=name.replace("_", " ")
        )
    ax.set_xscale("symlog", linthresh=0.01)
    ax.set_xticks([0, 0.01, 0.1, 1], ["0", "1 %", "10 %", "100 %"])
    ax.set_xlim(-0.002, 1.2)
    ax.set_ylim(bottom=0)
    ax.set(xlabel="unchanged runs with an alarm", ylabel="median delay [s]")
    return ax


@styled
def operating_figure(panels: Mapping[str, Mapping[str, Sequence[Point]]]) -> Figure:
    """One panel a set of curves, by name; one legend."""
    figure = Figure(figsize=(3.6 * len(panels) + 1.8, 3.6), layout="constrained")
    axes = figure.subplots(1, len(panels), squeeze=False, sharey=True)[0]
    for ax, (kind, curves) in zip(axes, panels.items(), strict=True):
        operating_curve(ax, curves).set_title(kind, fontsize=10)
    handles, labels = axes[0].get_legend_handles_labels()
    for ax in axes[1:]:
        for handle, label in zip(*ax.get_legend_handles_labels(), strict=True):
            if label not in labels:
                handles.append(handle)
                labels.append(label)
    figure.legend(handles, labels, loc="outside right upper")
    return figure
