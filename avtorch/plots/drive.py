"""Drawings of a drive: the whole of it, single manoeuvres, what is left of the gap, and what to drive next.

Long drives are drawn by envelopes: of each short interval the least and the greatest value, so that no peak is lost.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, FigureBase
from matplotlib.ticker import NullLocator

from avtorch.arrays import FloatArray, IntArray
from avtorch.errors import InputError
from avtorch.experiment import Experiment
from avtorch.gap.result.diagnosis import Diagnosis
from avtorch.gap.result.manoeuvres import Manoeuvre
from avtorch.gap.result.residuals import binned_means, correlation, residuals, spectrum, usual
from avtorch.gap.result.traces import Alarm, Reason, Traces, Uncounted
from avtorch.plots.diagnosis import budget_bars, traces_of
from avtorch.plots.style import BLACK, BLUE, GREY, LABELS, ORANGE, PURPLE, VERMILLION, WIDE, legend, panels_of, styled

Against = Literal["command", "speed", "frequency", "earlier commands"]

_INTERVALS = 260  # of a line
_SMALL = (4.0, 2.7)  # inches: as wide as a phone or half a desk's page
_COLOURS = {
    "command": GREY,
    "measured": BLACK,
    "baseline simulator": VERMILLION,
    "with what was named": BLUE,
    "repaired simulator": BLUE,
}
_BEYOND = 0.3  # of the measured range: how far beyond it a rollout is followed, whose speed may drift without end
_GROUNDS: dict[Reason, tuple[str, dict[str, Any]]] = {
    "driver": ("driver", {"facecolor": "#DDDDDD"}),
    "standstill": ("standstill", {"facecolor": "none", "edgecolor": "#BBBBBB", "hatch": "////"}),
    "gap": ("no rows", {"facecolor": "none", "edgecolor": "#BBBBBB", "hatch": "\\\\\\\\"}),
    "settling": ("settling", {"facecolor": "#E6E6E6"}),
}
"""What did not count: its label, and a ground that is told from the others without colour."""
_LOGS_APART = 0.02  # of the whole, between two logs


@dataclass(frozen=True)
class DriveTime:
    """Where the rows of a diagnosis lie on one axis: `along` (row,) [s], several logs one behind the other; `begins` of
    the logs on it [s]; `uncounted` and `alarms` at their times on it; `onset` on it [s], where an effect sets in.
    """

    along: FloatArray
    begins: tuple[float, ...]
    uncounted: tuple[Uncounted, ...]
    onset: float | None
    alarms: tuple[Alarm, ...] = ()

    @property
    def label(self) -> str:
        """Of the axis."""
        return "time [s]" if len(self.begins) == 1 else "time, one log behind the other [s]"


def drive_time(found: Diagnosis) -> DriveTime:
    """The axis of the whole drive. Raises `InputError` where there are no traces."""
    traces = traces_of(found)
    time, number = traces.time, traces.log
    apart = _LOGS_APART * float(sum(time[number == n].max() for n in np.unique(number)))
    begins = [0.0]
    for n in range(int(number[-1])):
        begins.append(begins[-1] + float(time[number == n].max()) + apart)
    along = time + np.array(begins)[number]
    moved = (replace(x, begin=x.begin + begins[x.log], end=x.end + begins[x.log]) for x in traces.uncounted)
    # the axis begins and ends with rows that count
    inside = tuple(x for x in moved if x.end > along[0] and x.begin < along[-1])
    onset = found.onset_from_start_s
    if onset is not None:
        onset += begins[min(found.onset_log, len(begins) - 1)]
    alarms = tuple(replace(x, at=x.at + begins[x.log]) for x in found.alarms if x.log < len(begins))
    return DriveTime(along, tuple(begins), inside, onset, alarms)


def envelope(time: FloatArray, values: FloatArray, stretch: IntArray, intervals: int) -> tuple[FloatArray, FloatArray]:
    """`values` (row,) over `time` as a line of at most two points for each of `intervals`, its least and its greatest
    value in the order in which they come; broken by NaN between stretches.
    """
    length = (time[-1] - time[0]) / intervals if len(time) > 1 else 1.0
    cell = np.minimum((time - time[0]) / max(length, 1e-12), intervals - 1).astype(int)
    x: list[float] = []
    y: list[float] = []
    cuts = np.flatnonzero((np.diff(cell) != 0) | (np.diff(stretch) != 0)) + 1
    for rows in np.split(np.arange(len(time)), cuts):
        if x and stretch[rows[0]] != stretch[rows[0] - 1]:
            x.append(float(time[rows[0]]))
            y.append(np.nan)
        ends = sorted({int(rows[values[rows].argmin()]), int(rows[values[rows].argmax()])})
        x += time[ends].tolist()
        y += values[ends].tolist()
    return np.array(x), np.array(y)


def _panels(found: Diagnosis) -> dict[str, dict[str, FloatArray]]:
    """What was measured and simulated over the whole drive: by the label of a channel's axis its lines (row,) by label.

    The command is with the acceleration or in a panel of its own; a simulated speed begins at the measured one every
    ten seconds (`Traces.begun_anew`). Raises `InputError` where there are no traces.
    """
    traces = traces_of(found)
    panels = {} if "accel" in traces.channels else {"command [m/s²]": {"command": traces.command}}
    sides = (traces.begun_anew(x) for x in (traces.before, traces.after))
    for name, measured, before, after in zip(traces.channels, traces.measured, *sides, strict=True):
        lines = {"command": traces.command} if name == "accel" else {}
        lines |= {"measured": measured, "baseline simulator": before}
        if found.free_form is not None:
            lines["repaired simulator"] = after
        elif found.winner.effects:
            lines["with what was named"] = after
        panels[LABELS[name]] = lines
    return panels


@styled
def drive_figure(found: Diagnosis) -> Figure:
    """The whole drive, a panel a channel, the command with the acceleration or in a panel of its own.

    A simulated speed begins at the measured one every ten seconds. Raises `InputError` where there are no traces.
    """
    panels = _panels(found)
    figure = Figure(figsize=(WIDE, 0.8 + 1.9 * len(panels)), layout="constrained")
    _drive(figure, found, panels)
    return figure


@styled
def diagnosis_figure(found: Diagnosis) -> Figure:
    """A diagnosis at a glance: the budget of the gap above the whole drive.

    Raises `InputError` where there is no budget, or no traces.

    Example:
        >>> from avtorch import Leader, diagnose, plots, simulate
        >>> from avtorch.gap import ConstantResistance, plant
        >>> car = plant([ConstantResistance(0.3)], sigma=0.02)
        >>> log = simulate(Leader.default(start=30.0, duration=100.0, dt=0.1), plant=car).log()
        >>> figure = plots.diagnosis_figure(diagnose(log, effects=["constant_resistance"], pairs=False))
        >>> [ax.get_xlabel() or ax.get_ylabel() for ax in figure.axes]
        ['share of the gap in held-out 10 s rollouts', 'acceleration [m/s²]', 'time [s]']
    """
    if found.budget is None:
        raise InputError("budget: the diagnosis has none to draw; its drives are too short to hold out blocks")
    panels = _panels(found)
    heights = 0.7 + 0.3 * max(len(found.budget.parts) + 1, 2), 0.8 + 1.6 * len(panels)
    figure = Figure(figsize=(WIDE, sum(heights)), layout="constrained")
    parts = figure.add_gridspec(2, 1, height_ratios=heights)
    above, below = figure.add_subfigure(parts[0]), figure.add_subfigure(parts[1])
    budget_bars(above.add_subplot(), found.budget)
    _drive(below, found, panels)
    return figure


def _drive(figure: FigureBase, found: Diagnosis, panels: Mapping[str, Mapping[str, FloatArray]]) -> None:
    axis, traces = drive_time(found), traces_of(found)
    axes = figure.subplots(len(panels), 1, sharex=True, squeeze=False)[:, 0]
    for ax, (name, lines) in zip(axes, panels.items(), strict=True):
        _shade(ax, axis)
        for label, values in lines.items():
            # what was logged does not begin anew with a rollout, and a simulated acceleration does not either
            anew = name == LABELS["speed"] and label not in ("command", "measured")
            parts = traces.piece if anew else traces.stretch
            line = envelope(axis.along, values, parts, _INTERVALS)
            ax.plot(*line, color=_COLOURS[label], lw=0.9, label=label)
        ax.set_ylabel(name)
        if "measured" in lines:
            low, high = float(lines["measured"].min()), float(lines["measured"].max())
            reach = _BEYOND * max(high - low, 1e-3)
            ax.set_ylim(low - reach, high + reach)
    axes[-1].set(xlabel=axis.label, xlim=(float(axis.along[0]), float(axis.along[-1])))
    legend(figure, axes, columns=3)


def _shade(ax: Axes, axis: DriveTime) -> None:
    told: set[str] = set()
    for x in axis.uncounted:
        label, look = _GROUNDS[x.why]
        ax.axvspan(x.begin, x.end, **look, lw=0, zorder=0, label=None if x.why in told else label)
        told.add(x.why)
    for begin in axis.begins[1:]:
        ax.axvline(begin, color=GREY, lw=0.8, ls=":", label="next log" if begin == axis.begins[1] else None)
    for i, alarm in enumerate(axis.alarms):
        ax.axvline(alarm.at, color=PURPLE, lw=0.9, ls="-.", label="alarm" if i == 0 else None)
    if axis.onset is not None:
        ax.axvline(axis.onset, color=BLACK, lw=1.0, ls="--", label="onset")


# single manoeuvres --------------------------------------------------------------------------------------------------
@styled
def manoeuvre_figure(manoeuvre: Manoeuvre, traces: Traces) -> Figure:
    """The accelerations of one manoeuvre over its log's time, as wide as a phone or half a desk's page."""
    figure = Figure(figsize=_SMALL, layout="constrained")
    ax = figure.add_subplot()
    for label, values in manoeuvre.lines.items():
        ax.plot(traces.time[manoeuvre.rows], values, color=_COLOURS[label], lw=1.2, label=label)
    ax.set(xlabel="time [s]", ylabel="acceleration [m/s²]")
    ax.margins(x=0)
    legend(figure, [ax], columns=2, fontsize=8)
    return figure


# what is left ------------------------------------------------------------------------------------------------------
def residuals_of(found: Diagnosis) -> dict[str, FloatArray]:
    """The residuals (row,) by label: without, and where something was named also with it.

    Raises `InputError` where there are no traces.
    """
    before, after = residuals(traces_of(found))
    both = {"baseline simulator": before, "with what was named": after}
    return both if found.winner.effects else {"baseline simulator": before}


def _against(ax: Axes, traces: Traces, both: Mapping[str, FloatArray], axis: Literal["command", "speed"]) -> None:
    """Means of the residual in bins of the command or the speed, with central 90 % intervals by blocks of the drive."""
    along = traces.command if axis == "command" else traces.speed
    assert along is not None, "a speed that was measured"
    for label, residual in both.items():
        bins = binned_means(traces, along, residual)
        ax.fill_between(bins.place, bins.low, bins.high, color=_COLOURS[label], alpha=0.2, lw=0)
        ax.plot(bins.place, bins.mean, "o-", color=_COLOURS[label], lw=1.2, ms=3, label=label)
    ax.axhline(0.0, color=BLACK, lw=0.8)
    ax.set(xlabel=f"{axis} [{'m/s²' if axis == 'command' else 'm/s'}]", ylabel="mean residual [m/s²]")


def _spectrum(ax: Axes, traces: Traces, both: Mapping[str, FloatArray]) -> None:
    """Power of the residual over frequency, with its central 90 %."""
    for label, residual in both.items():
        found = spectrum(traces, residual)
        if found is not None:
            # an interval of frequencies a point: a picture has no room for hundreds
            few = np.unique(np.geomspace(1, len(found.frequency), 60).astype(int)) - 1
            f, power, low, high = (x[few] for x in found)
            ax.fill_between(f, low, high, color=_COLOURS[label], alpha=0.2, lw=0)
            ax.plot(f, power, color=_COLOURS[label], lw=1.2, label=label)
    ax.set(xscale="log", yscale="log", xlabel="frequency [Hz]", ylabel="power [(m/s²)²/Hz]")
    ax.margins(x=0)
    for along in (ax.xaxis, ax.yaxis):
        along.set_minor_locator(NullLocator())
        along.set_major_formatter("{x:g}")


def _correlation(ax: Axes, traces: Traces, both: Mapping[str, FloatArray]) -> None:
    """Correlation of the residual with commands before it, and the band of 99 % for one that depends on none."""
    band = 0.0
    for label, residual in both.items():
        found = correlation(traces, residual)
        ax.plot(found.lag, found.value, color=_COLOURS[label], lw=1.2, label=label)
        band = found.band
    ax.axhspan(-band, band, color=GREY, alpha=0.25, lw=0, zorder=0)
    ax.axhline(0.0, color=BLACK, lw=0.8)
    ax.set(xlabel="time since the command [s]", ylabel="correlation [-]")
    ax.margins(x=0)


@styled
def residual_figure(found: Diagnosis, against: Against) -> Figure:
    """One of the drawings above, as wide as a phone or half a desk's page.

    Raises `InputError` where there are no traces.
    """
    figure, traces, both = Figure(figsize=_SMALL, layout="constrained"), traces_of(found), residuals_of(found)
    ax = figure.add_subplot()
    if against == "frequency":
        _spectrum(ax, traces, both)
    elif against == "earlier commands":
        _correlation(ax, traces, both)
    else:
        _against(ax, traces, both, against)
    legend(figure, [ax], columns=2, fontsize=8)
    return figure


@styled
def residual_time_figure(found: Diagnosis) -> Figure:
    """The residual over the whole drive, and where 99 % of a steady one with the same quartiles would lie."""
    traces, axis, both = traces_of(found), drive_time(found), residuals_of(found)
    figure, (ax,) = panels_of(1, 2.6)
    for label, residual in both.items():
        line = envelope(axis.along, residual, traces.stretch, _INTERVALS)
        ax.plot(*line, color=_COLOURS[label], lw=0.9, label=label)
    most = usual(list(both.values())[-1])
    ax.axhspan(-most, most, color=GREY, alpha=0.25, lw=0, zorder=0)
    ax.set(xlabel=axis.label, ylabel="residual [m/s²]", xlim=(float(axis.along[0]), float(axis.along[-1])))
    legend(figure, [ax])
    return figure


# what to drive next ------------------------------------------------------------------------------------------------
@styled
def experiment_figure(experiment: Experiment) -> Figure:
    """The command of the experiment to drive next, held between rows, over the speed that is expected of it."""
    m = experiment.manoeuvre
    figure = Figure(figsize=(WIDE, 4.0), layout="constrained")
    top, bottom = figure.subplots(2, 1, sharex=True)
    top.axhline(0.0, color=GREY, lw=0.6)
    top.step(m.time, m.command, where="post", color=BLUE, label="command")
    top.set(ylabel="command [m/s²]")
    top.set_title(m.name, loc="left")
    bottom.plot(m.time, m.speed, color=ORANGE, label="expected speed")
    bottom.set(xlabel="time [s]", ylabel="expected speed [m/s]", ylim=(0, 1.15 * float(m.speed.max())))
    bottom.margins(x=0)
    return figure
