"""Drawings of a diagnosis, its budget, its cause, where the gap lies, how far it shrinks; and of a comparison."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullLocator, PercentFormatter

from avtorch.arrays import FloatArray
from avtorch.errors import InputError
from avtorch.gap.quantity import Quantity
from avtorch.gap.result.attribution import UNITS, Axis
from avtorch.gap.result.budget import UNNAMED, Budget, percent
from avtorch.gap.result.counted_rows import HORIZON_S
from avtorch.gap.result.diagnosis import Diagnosis
from avtorch.gap.result.hypotheses import Candidate
from avtorch.gap.result.traces import Traces
from avtorch.gap.simulator.force_table import ForceTable, ResistanceCurve
from avtorch.io.clock import time_label
from avtorch.plots.style import BLACK, BLUE, GREY, LABELS, ORANGE, SKY, VERMILLION, legend, panels_of, styled

_CELLS = 24  # a side of the force map
_BINS = 30  # of a histogram
_MOST = 7  # hypotheses in a picture
_SECONDS = 25.0  # seconds of a drive in a picture


def budget_bars(ax: Axes, budget: Budget) -> Axes:
    """The gap's budget: each part's share begins where the one before it ends; whiskers are central 90 % intervals.

    Without any part all of the gap is unexplained, so the bars divide the error: what is unexplained, and noise.
    """
    rest = ORANGE if budget.parts or budget.unexplained.material else SKY
    colours = {"noise": GREY, "unexplained": rest, UNNAMED: SKY}
    begun, reach = 0.0, 1.0
    for i, (name, share) in enumerate(budget.shares.items()):
        colour = colours.get(name, BLUE)
        ax.barh(i, share.mean, left=begun, color=colour, height=0.64)
        ax.plot([begun + share.q05, begun + share.q95], [i, i], color=BLACK, lw=1.0)
        ax.text(max(begun + share.q95, begun + share.mean) + 0.012, i, percent(share.mean), va="center", fontsize=9)
        if i:
            ax.plot([begun, begun], [i - 1, i], color=GREY, lw=0.6)
        reach = max(reach, begun + share.q95)  # a whisker may end beyond the whole
        begun += share.mean
    ax.set_yticks(range(len(budget.shares)), list(budget.shares))
    ax.set(
        xlabel=f"share of the {'gap' if budget.parts else 'error'} in held-out {budget.horizon_s:.3g} s rollouts",
        xlim=(0, reach * 1.12),
        ylim=(len(budget.shares) - 0.4, -0.6),
    )
    ax.set_xticks(_UP_TO_ONE)
    ax.xaxis.set_major_formatter(PercentFormatter(1.0, 0, " %"))
    ax.grid(axis="y", visible=False)
    return ax


_UP_TO_ONE = (0.0, 0.2, 0.4, 0.6, 0.8, 1.0)


def traces_of(found: Diagnosis) -> Traces:
    """The traces of a diagnosis. Raises `InputError` where there are none."""
    if found.traces is None:
        raise InputError("traces: the diagnosis has none to draw")
    return found.traces


def _liveliest(traces: Traces, size: FloatArray, seconds: float) -> slice:
    """The window within one stretch in which `size` (row,) is largest."""
    best, worth = slice(0, len(size)), -1.0
    for rows in traces.stretches:
        width = min(len(rows), max(2, round(seconds / traces.step)))
        total = np.concatenate([[0.0], np.cumsum(size[rows])])
        sums = (total[width:] - total[:-width]) / width
        first = int(sums.argmax())
        if sums[first] > worth:
            best, worth = slice(int(rows[first]), int(rows[first]) + width), float(sums[first])
    return best


def _label(candidate: Candidate) -> str:
    """A hypothesis's name, on two lines."""
    count = len(candidate.effects)
    return candidate.name.replace("+", " +\n") if count < 3 else f"the {count} effects\nof the budget"


@styled
def budget_figure(found: Diagnosis) -> Figure:
    """The budget of the gap. Raises `InputError` where the diagnosis has none."""
    if found.budget is None:
        raise InputError("budget: the diagnosis has none to draw; its drives are too short to hold out blocks")
    figure, (ax,) = panels_of(1, 0.9 + 0.36 * len(found.budget.shares))
    budget_bars(ax, found.budget)
    return figure


@styled
def road_figure(found: Diagnosis) -> Figure:
    """What was measured, and what is simulated before and after the repair, where the effect does most.

    The channel is the acceleration, unless only the speed shows it. Raises `InputError` where there are no traces.
    """
    traces = traces_of(found)
    errors = [(traces.measured - x).std(-1) for x in (traces.before, traces.after)]
    shows = errors[0] / np.maximum(errors[1], 1e-12)
    # unlike the speed, the acceleration shows an event at its own time
    k = 0 if shows[0] > 1.1 else int(np.argmax(shows))
    of_speed = traces.channels[k] == "speed"
    # beyond the horizon a simulated speed may be anywhere
    seconds = min(_SECONDS, HORIZON_S) if of_speed else _SECONDS
    inside = _liveliest(traces, np.abs(traces.before[k] - traces.after[k]), seconds)
    measured, before, after = (x[k][inside] for x in (traces.measured, traces.before, traces.after))
    if of_speed:  # a rollout begun at the measured speed
        before, after = (x + measured[0] - x[0] for x in (before, after))
    figure, (ax,) = panels_of(1, 3.3)
    time = traces.time[inside]
    ax.plot(time, measured, color=BLACK, lw=1.2, label="measured")
    ax.plot(time, before, color=VERMILLION, label="baseline simulator")
    if found.winner.effects:
        named = found.verdict.names
        label = f"with {' and '.join(named)}" if len(named) < 3 else f"with all {len(named)} effects"
        ax.plot(time, after, color=BLUE, label=label)
    epochs_s = found.log.epochs_s
    ax.set(xlabel=time_label(epochs_s[0] if len(epochs_s) == 1 else 0.0), ylabel=LABELS[traces.channels[k]])
    ax.margins(x=0)
    legend(figure, [ax])
    return figure


@styled
def where_figure(found: Diagnosis) -> Figure:
    """Where the gap lies: along every axis that the log has the shares of the rows and of the effect's response, and
    the named parts. Raises `InputError` where there are no traces."""
    traces = traces_of(found)
    axes: dict[Axis, FloatArray | None] = {"time": traces.time, "speed": traces.speed, "command": traces.command}
    there: dict[Axis, FloatArray] = {axis: x for axis, x in axes.items() if x is not None}
    figure, panels = panels_of(len(there), 2.6)
    for i, (ax, (axis, x)) in enumerate(zip(panels, there.items(), strict=True)):
        low, high = np.quantile(x, (0.002, 0.998))
        edges = np.linspace(low, high if high > low else low + 1, _BINS + 1)
        rows, does = (np.histogram(x, edges, weights=weights)[0] for weights in (None, traces.does))
        look = {"fill": True, "facecolor": "#DDDDDD", "edgecolor": GREY, "lw": 0.8}
        ax.stairs(rows / max(rows.sum(), 1), edges, label="the drive", **look)
        if does.sum() > 0:
            ax.stairs(does / does.sum(), edges, color=BLUE, lw=1.6, label="the effect")
        away = found.log.epochs_s[0] if axis == "time" else 0.0
        for part in found.where:
            if part.axis == axis and not isinstance(part.begin, str) and not isinstance(part.end, str):
                ends = part.begin - away, part.end - away
                ax.axvspan(*ends, color=ORANGE, alpha=0.18, lw=0, label="named part of the gap")
        ax.set(xlabel=f"{axis} [{UNITS[axis]}]", ylabel="" if i else "share", ylim=(0, None))
        ax.margins(x=0)
    legend(figure, panels)
    return figure


@styled
def which_figure(found: Diagnosis) -> Figure:
    """A bar for each of the most probable hypotheses, the first at the top; the alias set in blue, the rest in grey."""
    some = list(found.candidates[:_MOST])[::-1]
    figure, (ax,) = panels_of(1, 0.9 + 0.36 * len(some))
    colours = [BLUE if c.name in found.verdict.alias_set else "#BBBBBB" for c in some]
    ax.barh(range(len(some)), [c.probability for c in some], color=colours, height=0.64)
    ax.set_yticks(range(len(some)), map(_label, some))
    for i, c in enumerate(some):
        ax.text(c.probability + 0.01, i, f"{c.probability:.2f}", va="center", fontsize=9, color=BLACK)
    ax.set_xticks(_UP_TO_ONE)
    ax.set(xlabel="probability", xlim=(0, 1.1), ylim=(-0.5, len(some) - 0.5))
    ax.grid(axis="y", visible=False)
    return figure


@styled
def shrinkage_figure(found: Diagnosis) -> Figure:
    """Errors in held-out free runs, a panel a channel: before, with a black box, after, and the noise floor.

    Raises `InputError` where nothing was held out.
    """
    scores = found.shrinkage
    if scores is None:
        raise InputError("shrinkage: found none, needs a diagnosis that names an effect")
    metrics = {w: m for w in ("accel", "speed") if (m := f"rollout_rmse_{w}") in scores.by_metric}
    figure, panels = panels_of(len(metrics), 3.2)
    for ax, (channel, metric) in zip(panels, metrics.items(), strict=True):
        own = scores.by_metric[metric]
        bars = (
            ("baseline simulator", own.before, VERMILLION),
            ("baseline with black box", scores.ceiling[metric], GREY),
            ("with the effect", own.after, BLUE),
            ("noise floor", own.floor, SKY),
        )
        for at, (label, value, colour) in enumerate(bars):
            ax.bar(at, value, color=colour, width=0.6, label=label)
        over = "" if own.horizon_s is None else f" in free runs of {own.horizon_s:.3g} s"
        ax.set_xticks([])
        ax.set(xlabel=f"held-out blocks{over}", ylabel=f"error of {LABELS[channel]}", ylim=(0, None))
    legend(figure, panels)
    return figure


def _force_contours(ax: Axes, traces: Traces | None, table: ForceTable) -> None:
    """Force beyond K u [m/s²] of the force map over speed and command; hatched, what was not driven: there only its
    smoothness speaks, and far from the drive it goes back to K u."""
    u, v, force = (np.array(x) for x in (table.command_mps2, table.speed_mps, table.force_mps2))
    most = max(float(np.abs(force).max()), 1e-6)
    drawn = ax.contourf(v, u, force, levels=np.linspace(-most, most, 13), cmap="RdBu_r")
    ax.figure.colorbar(drawn, ax=ax, label="force beyond K u [m/s²]", format="%.2g")
    ends = v[[0, -1]], u[[0, -1]]
    if traces is not None and traces.speed is not None:
        ends = np.clip([traces.speed.min(), traces.speed.max()], *ends[0]), ends[1]
        edges = [np.linspace(low, high, _CELLS + 1) for low, high in ends]
        driven = np.histogram2d(traces.speed, traces.command, bins=edges)[0] > 0
        # contourf takes values in the middle of cells
        middle = [0.5 * (x[1:] + x[:-1]) for x in edges]
        ax.contourf(*middle, (~driven).T.astype(float), levels=[0.5, 1.5], colors="none", hatches=["////"])
    ax.axhline(0.0, color=GREY, lw=0.8)
    ax.set(xlabel="speed [m/s]", ylabel="command [m/s²]", xlim=ends[0], ylim=ends[1])
    ax.grid(visible=False)


def _resistance_line(ax: Axes, traces: Traces | None, curve: ResistanceCurve) -> None:
    """The resistance of the free form [m/s²] over speed, and where the middle nine tenths of the drive lie; where
    nothing was driven it is a line."""
    ax.plot(curve.speed_mps, curve.force_mps2, color=BLUE, marker=".")
    if traces is not None and traces.speed is not None:
        low, high = np.quantile(traces.speed, (0.05, 0.95))
        ax.axvspan(float(low), float(high), color=GREY, alpha=0.15, lw=0)
    ax.axhline(0.0, color=BLACK, lw=0.8)
    ax.set(xlabel="speed [m/s]", ylabel="acceleration [m/s²]")


@styled
def free_form_figure(found: Diagnosis) -> Figure:
    """What the repaired simulator carries without a name, a panel for the map and one for the resistance.

    Raises `InputError` where it carries nothing.
    """
    if not found.free_form:
        raise InputError("free_form: the repaired simulator carries nothing without a name")
    figure, axes = panels_of(len(found.free_form), 3.3, wide=4.3 * len(found.free_form))
    for ax, part in zip(axes, found.free_form, strict=True):
        if isinstance(part, ForceTable):
            _force_contours(ax, found.traces, part)
        else:
            _resistance_line(ax, found.traces, part)
    return figure


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
