"""Drawings of what is left of the gap: residuals against command, speed, time, frequency and earlier commands."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator

from avtorch.arrays import FloatArray
from avtorch.errors import InputError
from avtorch.gap.result.diagnosis import Diagnosis
from avtorch.gap.result.residuals import Residuals
from avtorch.plots.style import BLACK, BLUE, GREY, VERMILLION, styled
from avtorch.plots.whole_drive import drive_time, envelope

Against = Literal["command", "speed", "frequency", "earlier commands"]
_COLOURS = {"baseline simulator": VERMILLION, "with what was named": BLUE}
_SIZE = (4.0, 2.7)


def residuals_of(found: Diagnosis) -> Residuals:
    """The residuals of a diagnosis. Raises `InputError` where it has no traces.

    Example:
        >>> from avtorch import Leader, diagnose, simulate
        >>> from avtorch.gap import DeadTime, plant
        >>> from avtorch.plots.residuals import residuals_of
        >>> late = plant([DeadTime(0.4)], sigma=0.0)
        >>> log = simulate(Leader.default(start=50.0, duration=14.0, dt=0.1), plant=late).log()
        >>> left = residuals_of(diagnose(log, effects=["dead_time"], pairs=False))
        >>> left.channel, bool(left.after.std() < left.before.std())
        ('accel', True)
    """
    if found.traces is None:
        raise InputError("traces: the diagnosis has none to draw")
    return Residuals.of(found.traces)


def sides(found: Diagnosis, left: Residuals) -> Mapping[str, FloatArray]:
    """The residuals (row,) by label: without, and where something was named also with it."""
    both = {"baseline simulator": left.before, "with what was named": left.after}
    return both if found.winner.effects else {"baseline simulator": left.before}


def residuals_against(ax: Axes, found: Diagnosis, axis: Literal["command", "speed"]) -> Axes:
    """Means of the residual in bins of the command or the speed, with central 90 % intervals by blocks of the drive.

    Raises `InputError` where there are no traces, or no speed.
    """
    left = residuals_of(found)
    along = left.command if axis == "command" else left.speed
    if along is None:
        raise InputError("axis: found speed, needs a log in which it was measured")
    for label, residual in sides(found, left).items():
        bins = left.against(along, residual)
        ax.fill_between(bins.place, bins.low, bins.high, color=_COLOURS[label], alpha=0.2, lw=0)
        ax.plot(bins.place, bins.mean, "o-", color=_COLOURS[label], lw=1.2, ms=3, label=label)
    ax.axhline(0.0, color=BLACK, lw=0.8)
    ax.set(xlabel=f"{axis} [{'m/s²' if axis == 'command' else 'm/s'}]", ylabel="mean residual [m/s²]")
    return ax


def residual_spectrum(ax: Axes, found: Diagnosis) -> Axes:
    """Power of the residual over frequency, with its central 90 %. Raises `InputError` where there are no traces."""
    left = residuals_of(found)
    for label, residual in sides(found, left).items():
        spectrum = left.spectrum(residual)
        if spectrum is not None:
            # an interval of frequencies a point: a picture has no room for hundreds
            few = np.unique(np.geomspace(1, len(spectrum.frequency), 60).astype(int)) - 1
            f, power, low, high = (x[few] for x in (spectrum.frequency, spectrum.power, spectrum.low, spectrum.high))
            ax.fill_between(f, low, high, color=_COLOURS[label], alpha=0.2, lw=0)
            ax.plot(f, power, color=_COLOURS[label], lw=1.2, label=label)
    ax.set(xscale="log", yscale="log", xlabel="frequency [Hz]", ylabel="power [(m/s²)²/Hz]")
    ax.margins(x=0)
    for along in (ax.xaxis, ax.yaxis):
        along.set_minor_locator(NullLocator())
        along.set_major_formatter("{x:g}")
    return ax


def residual_correlation(ax: Axes, found: Diagnosis) -> Axes:
    """Correlation of the residual with commands before it, and the band of 99 % for one that does not depend on them.

    Raises `InputError` where there are no traces.
    """
    left = residuals_of(found)
    band = 0.0
    for label, residual in sides(found, left).items():
        both = left.correlation(residual)
        ax.plot(both.lag, both.value, color=_COLOURS[label], lw=1.2, label=label)
        band = both.band
    ax.axhspan(-band, band, color=GREY, alpha=0.25, lw=0, zorder=0)
    ax.axhline(0.0, color=BLACK, lw=0.8)
    ax.set(xlabel="time since the command [s]", ylabel="correlation [-]")
    ax.margins(x=0)
    return ax


_DRAW: Mapping[Against, Callable[[Axes, Diagnosis], Axes]] = {
    "command": lambda ax, found: residuals_against(ax, found, "command"),
    "speed": lambda ax, found: residuals_against(ax, found, "speed"),
    "frequency": residual_spectrum,
    "earlier commands": residual_correlation,
}


@styled
def residual_figure(found: Diagnosis, against: Against) -> Figure:
    """One of the drawings above, as wide as a phone or half a desk's page."""
    figure = Figure(figsize=_SIZE, layout="constrained")
    ax = _DRAW[against](figure.add_subplot(), found)
    figure.legend(*ax.get_legend_handles_labels(), loc="outside upper left", ncols=2, fontsize=8)
    return figure


@styled
def residual_time_figure(found: Diagnosis, *, narrow: bool = False) -> Figure:
    """The residual over the whole drive, and where 99 % of a steady one with the same quartiles would lie."""
    left, axis = residuals_of(found), drive_time(found)
    assert found.traces is not None
    along = axis.along[
        np.searchsorted(_rising(found.traces.time, found.traces.stretch), _rising(left.time, left.stretch))
    ]
    width, intervals = (4.0, 120) if narrow else (8.6, 260)
    figure = Figure(figsize=(width, 2.6), layout="constrained")
    ax = figure.add_subplot()
    usual = 0.0
    for label, residual in sides(found, left).items():
        ax.plot(*envelope(along, residual, left.stretch, intervals), color=_COLOURS[label], lw=0.9, label=label)
        usual = left.usual(residual)
    ax.axhspan(-usual, usual, color=GREY, alpha=0.25, lw=0, zorder=0)
    ax.set(
        xlabel="time [s]" if len(axis.begins) == 1 else "time, one log behind the other [s]", ylabel="residual [m/s²]"
    )
    ax.set_xlim(float(axis.along[0]), float(axis.along[-1]))
    figure.legend(*ax.get_legend_handles_labels(), loc="outside upper left", ncols=2)
    return figure


def _rising(time: FloatArray, stretch: FloatArray | np.ndarray) -> FloatArray:
    """A key of rows that rises over all stretches, of which several logs may have the same times."""
    return stretch * 1e7 + time
