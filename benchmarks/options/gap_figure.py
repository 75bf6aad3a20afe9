"""Drawings of the benefits and costs of a longer time gap."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from avtorch.plots.style import BLACK, BLUE, GREEN, GREY, ORANGE, VERMILLION, styled

if TYPE_CHECKING:
    from benchmarks.options.trade_off import GapTradeOff

_COLOURS = (VERMILLION, BLUE, GREEN, ORANGE, BLACK)


def gap_probability(ax: Axes, curves: Mapping[str, GapTradeOff], *, required: float = 0.95) -> Axes:
    """P(string stable) over the time gap, one line per curve, by name; the required level in grey."""
    for colour, (name, curve) in zip(_COLOURS, curves.items(), strict=False):
        ax.plot(curve.time_gap, curve.p_string_stable, color=colour, label=name)
    ax.axhline(required, color=GREY, linestyle=":", linewidth=1)
    ax.set(xlabel="time gap [s]", ylabel="P(string stable)", ylim=(-0.03, 1.03))
    return ax


def gap_peak(ax: Axes, curves: Mapping[str, GapTradeOff]) -> Axes:
    """Median peak gain over the time gap, with its 90 % interval."""
    for colour, (name, curve) in zip(_COLOURS, curves.items(), strict=False):
        low, middle, high = curve.peak_gain
        ax.plot(curve.time_gap, middle, color=colour, label=name)
        ax.fill_between(curve.time_gap, low, high, color=colour, alpha=0.2, linewidth=0)
    ax.axhline(1.0, color=GREY, linestyle=":", linewidth=1)
    ax.set(xlabel="time gap [s]", ylabel="peak gain [-]")
    return ax


def gap_throughput(ax: Axes, curve: GapTradeOff, *, marked: tuple[float, ...] = ()) -> Axes:
    """Equilibrium throughput over the time gap; the driver's settings are marked with their numbers."""
    ax.plot(curve.time_gap, curve.throughput_vph, color=BLACK)
    for gap in marked:
        i = int((curve.time_gap - gap).abs().argmin())
        flow = float(curve.throughput_vph[i])
        ax.plot(float(curve.time_gap[i]), flow, "o", color=BLUE)
        ax.annotate(f"{gap:g} s: {flow:.0f}", (gap, flow), xytext=(5, 5), textcoords="offset points", fontsize=8)
    ax.set(xlabel="time gap [s]", ylabel=f"vehicles an hour at {curve.speed_mps:g} m/s")
    return ax


@styled
def gap_figure(curves: Mapping[str, GapTradeOff], *, marked: tuple[float, ...] = ()) -> Figure:
    """Probability, peak gain and throughput over the time gap, side by side."""
    figure = Figure(figsize=(11.5, 3.6), layout="constrained")
    left, middle, right = figure.subplots(1, 3)
    gap_probability(left, curves).set_title("bought: string stability")
    gap_peak(middle, curves).set_title("bought: less amplification")
    middle.legend(loc="upper right")
    gap_throughput(right, next(iter(curves.values())), marked=marked).set_title("paid: throughput of a lane")
    return figure
