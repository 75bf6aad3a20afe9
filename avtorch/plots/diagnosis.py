"""Drawings of a diagnosis: the gap over time, where it lies, its cause, how far it shrinks, the loop's stability."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter

from avtorch.arrays import FloatArray, IntArray
from avtorch.errors import InputError
from avtorch.gap.budget.parts import LIKELY, Budget, percent
from avtorch.gap.crossval.localisation import UNITS, Axis
from avtorch.gap.result.diagnosis import Candidate, Diagnosis
from avtorch.io.clock import time_label
from avtorch.plots.style import BLACK, BLUE, GREY, ORANGE, SKY, VERMILLION, styled
from avtorch.vehicle.stability import Chain, chain_gain

_SECONDS = 25.0  # seconds of a drive in a picture
_NAMES = {"accel": "acceleration [m/s²]", "speed": "speed [m/s]"}


def budget_bars(ax: Axes, budget: Budget) -> Axes:
    """The gap's budget: each part's share begins where the one before it ends; whiskers are central 90 % intervals."""
    named = [(p.name, p.share, BLUE if p.probability >= LIKELY else SKY) for p in budget.parts]
    rows = [*named, ("unexplained", budget.unexplained.share, ORANGE)]
    begun = 0.0
    for i, (_, share, colour) in enumerate(rows):
        ax.barh(i, share.mean, left=begun, color=colour, height=0.62)
        ax.plot([begun + share.q05, begun + share.q95], [i, i], color=BLACK, lw=1.0)
        ax.text(max(begun + share.q95, begun + share.mean) + 0.012, i, percent(share.mean), va="center", fontsize=9)
        if i:
            ax.plot([begun, begun], [i - 1, i], color=GREY, lw=0.6)
        begun += share.mean
    ax.set_yticks(range(len(rows)), [name for name, _, _ in rows])
    ax.set(
        xlabel=f"share of the gap in held-out {budget.horizon_s:.3g} s rollouts",
        xlim=(0, 1.12),
        ylim=(len(rows) - 0.4, -0.6),
    )
    ax.xaxis.set_major_formatter(PercentFormatter(1.0, 0, " %"))
    ax.grid(axis="y", visible=False)
    return ax


def gap_on_the_road(ax: Axes, found: Diagnosis, *, seconds: float = _SECONDS) -> Axes:
    """Measured, simulated before and after the repair, over the stretch of the drive in which the effect does most.

    The channel is the acceleration, unless only the speed shows it. Raises `InputError` where there are no traces.
    """
    traces = found.traces
    if traces is None:
        raise InputError("traces: the diagnosis has none to draw")
    errors = [(traces.measured - x).std(-1) for x in (traces.before, traces.after)]
    shows = errors[0] / np.maximum(errors[1], 1e-12)
    # unlike the speed, the acceleration shows an event at its own time
    k = 0 if shows[0] > 1.1 else int(np.argmax(shows))
    inside = _liveliest(traces.time, traces.stretch, np.abs(traces.before[k] - traces.after[k]), seconds)
    time = traces.time[inside]
    offset = np.zeros(2)
    if traces.channels[k] == "speed":
        # a rollout begun at the measured speed
        offset = np.array([(traces.measured[k] - x[k])[inside][0] for x in (traces.before, traces.after)])
    ax.plot(time, traces.measured[k][inside], color=BLACK, lw=1.2, label="measured")
    ax.plot(time, traces.before[k][inside] + offset[0], color=VERMILLION, label="baseline simulator")
    if found.winner.effects:
        named = found.verdict.names
        label = f"with {' and '.join(named)}" if len(named) < 3 else f"with all {len(named)} effects"
        ax.plot(time, traces.after[k][inside] + offset[1], color=BLUE, label=label)
    ax.set(
        xlabel=time_label(found.log.epochs_s[0] if len(found.log.epochs_s) == 1 else 0.0),
        ylabel=_NAMES[traces.channels[k]],
    )
    ax.margins(x=0)
    ax.legend(loc="upper center", bbox_to_anchor=(0.5, 1.14), ncols=3)
    return ax


def _liveliest(time: FloatArray, stretch: IntArray, size: FloatArray, seconds: float) -> slice:
    """The window within one stretch in which `size` (row,) is largest."""
    best, worth = slice(0, len(time)), -1.0
    for number in np.unique(stretch):
        rows = np.flatnonzero(stretch == number)
        step = float(np.median(np.diff(time[rows]))) if len(rows) > 1 else 1.0
        width = min(len(rows), max(2, round(seconds / step)))
        total = np.concatenate([[0.0], np.cumsum(size[rows])])
        sums = total[width:] - total[:-width]
        first = int(sums.argmax())
        if float(sums[first]) / width > worth:
            best, worth = slice(int(rows[first]), int(rows[first]) + width), float(sums[first]) / width
    return best


def where_it_lies(ax: Axes, found: Diagnosis, axis: Axis) -> Axes:
    """Along `axis` (time, speed or command): the share of rows, the share of the effect's response, and the named
    parts.

    Raises `InputError` where there are no traces or the log has no such signal.
    """
    traces = found.traces
    if traces is None:
        raise InputError("traces: the diagnosis has none to draw")
    x = {"time": traces.time, "command": traces.command, "speed": traces.speed}.get(axis)
    if x is None:
        raise InputError(f"axis: found {axis!r}, needs time, command, or speed where it was measured")
    low, high = np.quantile(x, (0.002, 0.998))
    edges = np.linspace(low, high if high > low else low + 1, 31)
    rows, _ = np.histogram(x, edges)
    does, _ = np.histogram(x, edges, weights=traces.does)
    ax.stairs(rows / max(rows.sum(), 1), edges, fill=True, color="#DDDDDD", label="the drive")
    if does.sum() > 0:
        ax.stairs(does / does.sum(), edges, color=BLUE, lw=1.6, label="the effect")
    for part in found.where:
        if part.axis == axis and not isinstance(part.begin, str) and not isinstance(part.end, str):
            away = found.log.epochs_s[0] if axis == "time" else 0.0
            ax.axvspan(
                part.begin - away, part.end - away, color=ORANGE, alpha=0.18, lw=0, label="named part of the gap"
            )
    ax.set(xlabel=f"{axis} [{UNITS[axis]}]", ylabel="share", ylim=(0, None))
    ax.margins(x=0)
    return ax


def probabilities(ax: Axes, found: Diagnosis, *, most: int = 7) -> Axes:
    """One bar per candidate, the most probable first; the alias set in blue, the rest in grey."""
    some = list(found.candidates[:most])[::-1]
    colours = [BLUE if c.name in found.verdict.alias_set else "#BBBBBB" for c in some]
    ax.barh(range(len(some)), [c.probability for c in some], color=colours, height=0.7)
    ax.set_yticks(range(len(some)), [_label(c) for c in some])
    for i, c in enumerate(some):
        ax.text(c.probability + 0.01, i, f"{c.probability:.2f}", va="center", fontsize=9, color=BLACK)
    ax.set(xlabel="probability", xlim=(0, 1.1))
    ax.grid(axis="y", visible=False)
    return ax


def _label(candidate: Candidate) -> str:
    """A hypothesis's name on at most two lines."""
    count = len(candidate.effects)
    return candidate.name.replace("+", " +\n") if count < 3 else f"the {count} effects\nof the budget"


_HORIZONS = ("0.5s", "2s", "10s", "whole")


def shrinkage(ax: Axes, found: Diagnosis, channel: str) -> Axes:
    """Rollout errors of a `channel` over their horizons: before, after, noise floor, and with a black box.

    Raises `InputError` where nothing was held out, or not this channel.
    """
    scores = found.shrinkage
    names = [_metric(channel, h) for h in _HORIZONS]
    if scores is None or names[0] not in scores.by_metric:
        raise InputError(f"shrinkage: found none of {channel}, needs a diagnosis that names an effect")
    at = np.arange(len(names))
    each = [scores.by_metric[name] for name in names]
    lines: Sequence[tuple[str, list[float], str, str]] = (
        ("baseline simulator", [c.before for c in each], VERMILLION, "o"),
        ("baseline with black box", [scores.ceiling[name] for name in names], GREY, "x"),
        ("with the effect", [c.after for c in each], BLUE, "o"),
        ("noise floor", [c.floor for c in each], SKY, "_"),
    )
    for label, values, colour, marker in lines:
        ax.plot(at, values, color=colour, marker=marker, lw=1.2, ms=7, label=label)
    ax.set_xticks(at, ["whole drive" if c.horizon_s is None else f"{c.horizon_s:.3g} s" for c in each])
    ax.set(xlabel="rollout over", ylabel=f"error of {_NAMES[channel]}")
    ax.set_ylim(0, None)
    return ax


def _metric(channel: str, horizon: str) -> str:
    return f"rollout_rmse_{channel}" + ("" if horizon == "10s" else f"_{horizon}")


def loop_gain(ax: Axes, chains: Mapping[str, tuple[Chain, dict]], *, colours: Mapping[str, str] | None = None) -> Axes:
    """|V / V_lead| over frequency [Hz] with the band of 90 % of the draws, by label: a chain and its setting.

    A setting is the keyword arguments of `avtorch.vehicle.stability.chain_gain`. Above 1 a disturbance grows from car
    to car.
    """
    given = dict(colours or {})
    palette = iter((VERMILLION, BLUE, GREY, ORANGE))
    for label, (chain, setting) in chains.items():
        gain = chain_gain(chain, **setting).reshape(-1, len(chain.omega)).numpy()
        f = chain.omega.numpy() / (2 * np.pi)
        colour = given.get(label) or next(palette)
        low, middle, high = np.quantile(gain, (0.05, 0.5, 0.95), axis=0)
        ax.plot(f, middle, color=colour, label=label)
        if len(gain) > 1:
            ax.fill_between(f, low, high, color=colour, alpha=0.18, lw=0)
    ax.axhline(1.0, color=BLACK, lw=0.8)
    ax.set(xscale="log", xlim=(0.005, 2.0), xlabel="frequency [Hz]", ylabel="speed, follower / leader")
    ax.set_ylim(0, min(max(1.3, ax.get_ylim()[1]), 4.0))
    return ax


@styled
def budget_figure(found: Diagnosis) -> Figure:
    """The budget of the gap. Raises `InputError` where the diagnosis has none."""
    if found.budget is None:
        raise InputError("budget: the diagnosis has none to draw; its drives are too short to hold out blocks")
    figure = Figure(figsize=(8.6, 1.0 + 0.36 * (len(found.budget.parts) + 1)), layout="constrained")
    budget_bars(figure.add_subplot(), found.budget)
    return figure


@styled
def road_figure(found: Diagnosis) -> Figure:
    """The picture of the gap over time."""
    figure = Figure(figsize=(8.6, 3.3), layout="constrained")
    gap_on_the_road(figure.add_subplot(), found)
    return figure


@styled
def where_figure(found: Diagnosis) -> Figure:
    """Where the gap lies, along every axis that the log has."""
    axes: list[Axis] = ["time", "command"]
    if found.traces is not None and found.traces.speed is not None:
        axes.insert(1, "speed")
    figure = Figure(figsize=(8.6, 2.5), layout="constrained")
    for i, axis in enumerate(axes):
        ax = where_it_lies(figure.add_subplot(1, len(axes), i + 1), found, axis)
        if i:
            ax.set_ylabel("")
        else:
            ax.legend(loc="upper left", fontsize=8)
    return figure


@styled
def which_figure(found: Diagnosis) -> Figure:
    """Candidates and their probabilities."""
    figure = Figure(figsize=(8.6, 0.9 + 0.36 * min(len(found.candidates), 7)), layout="constrained")
    probabilities(figure.add_subplot(), found)
    return figure


@styled
def shrinkage_figure(found: Diagnosis) -> Figure:
    """How far the gap shrinks, a panel per channel."""
    scores = found.shrinkage
    names = [] if scores is None else [w for w in ("accel", "speed") if f"rollout_rmse_{w}" in scores.by_metric]
    figure = Figure(figsize=(8.6, 3.0), layout="constrained")
    for i, channel in enumerate(names):
        ax = shrinkage(figure.add_subplot(1, len(names), i + 1), found, channel)
        if not i:
            ax.legend(fontsize=8)
    return figure
