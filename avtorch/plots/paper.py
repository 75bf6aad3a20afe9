"""Drawings of the paper's experiments, rerun. Each takes an axes and returns it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from numpy.typing import ArrayLike

from avtorch.plots.style import BLACK, BLUE, GREEN, GREY, LABELS, ORANGE, PURPLE, SKY, VERMILLION, short

#: One colour a kind of setting, here and in every picture of strategies.
SETTINGS: dict[str, dict[str, Any]] = {
    "leader": {"color": GREY, "linewidth": 1.1},
    "no action": {"color": VERMILLION, "linewidth": 1.2},
    "as printed, upper level only": {"color": ORANGE, "linewidth": 1.3},
    "as printed, with the lower level": {"color": PURPLE, "linewidth": 1.3},
    "our strategist": {"color": BLUE, "linewidth": 1.7},
}

_LINES = ((BLUE, "o"), (ORANGE, "s"), (PURPLE, "^"), (GREEN, "D"), (VERMILLION, "v"), (SKY, "P"), (BLACK, "X"))


def tracked(ax: Axes, truth: ArrayLike, mean: ArrayLike, low: ArrayLike, high: ArrayLike, *, name: str) -> Axes:
    """Estimates against the truth (setting,): one mark and one 90 % interval a run (setting, run), and the diagonal.

    Runs of one setting stand side by side, a little apart.
    """
    x, m, lo, hi = (np.asarray(v, dtype=float) for v in (truth, mean, low, high))
    nearest = np.diff(np.unique(x)).min() if len(x) > 1 else x[0]
    at = x[:, None] + 0.6 * nearest * np.linspace(-0.5, 0.5, m.shape[1])
    ax.plot([x.min(), x.max()], [x.min(), x.max()], color=BLACK, linestyle="--", linewidth=1.0, label="truth", zorder=1)
    ax.vlines(at.ravel(), lo.ravel(), hi.ravel(), color=BLUE, alpha=0.55, linewidth=1.1, label="90 % interval, a run")
    ax.plot(at.ravel(), m.ravel(), ".", color=BLUE, markersize=3, label="mean")
    ax.set_xlabel(f"true {LABELS[name]}")
    ax.set_ylabel(f"estimated {short(name)}" + (" [s]" if name == "T_L" else " [-]"))
    return ax


def error_growth(ax: Axes, x: ArrayLike, errors: Mapping[str, ArrayLike], *, along: str, of: str) -> Axes:
    """Absolute errors (setting, run) over the swept parameter, log-log: median, and the central 90 % of the runs."""
    x = np.asarray(x, dtype=float)
    for (name, values), (colour, marker) in zip(errors.items(), _LINES, strict=False):
        v = np.maximum(np.asarray(values, dtype=float), 1e-9)
        low, middle, high = np.quantile(v, [0.05, 0.5, 0.95], axis=-1)
        ax.fill_between(x, low, high, color=colour, alpha=0.15, linewidth=0)
        ax.plot(x, middle, color=colour, marker=marker, markersize=4, label=name)
    ax.set_xscale("log")
    ax.set_yscale("log")
    ax.set_xticks(x, [f"{t:g}" for t in x])
    ax.minorticks_off()
    ax.set_xlabel(f"true {LABELS[along]}")
    ax.set_ylabel(f"error of {short(of)}" + (" [s]" if of == "T_L" else " [-]"))
    return ax


def setting_traces(ax: Axes, time: ArrayLike, traces: Mapping[str, ArrayLike], *, quantity: str) -> Axes:
    """Speeds or accelerations (time,) under several settings, named as in `SETTINGS`."""
    for name, values in traces.items():
        ax.plot(np.asarray(time), np.asarray(values), label=name, **SETTINGS.get(name, {}))
    ax.set_ylabel(LABELS[quantity])
    ax.set_xlim(np.asarray(time)[0], np.asarray(time)[-1])
    return ax


def setting_gains(ax: Axes, omega: ArrayLike, curves: Mapping[str, ArrayLike]) -> Axes:
    """|G(jω)| (frequency,) of several settings, named as in `SETTINGS`; above one, disturbances grow."""
    ax.axhline(1.0, color=GREY, linewidth=1.0, linestyle=":")
    for name, values in curves.items():
        ax.plot(np.asarray(omega), np.asarray(values), label=name, **SETTINGS.get(name, {}))
    ax.set_xscale("log")
    ax.set_xlim(np.asarray(omega)[0], np.asarray(omega)[-1])
    ax.set_ylim(0.0, None)
    ax.set_xlabel("frequency ω [rad/s]")
    return ax


def gain_effects(ax: Axes, factors: Sequence[float], measured: Mapping[str, ArrayLike], *, gain: str) -> Axes:
    """Effect of a gain: measures (factor,) relative to those with the default gain."""
    for (name, values), (colour, marker) in zip(measured.items(), _LINES, strict=False):
        v = np.asarray(values, dtype=float)
        ax.plot(np.asarray(factors), v / v[0], color=colour, marker=marker, markersize=4, label=name)
    ax.axhline(1.0, color=GREY, linewidth=1.0, linestyle=":")
    ax.set_xlabel(f"${gain}$, times its default")
    return ax


def platoon_speeds(ax: Axes, time: ArrayLike, leader: ArrayLike, speeds: ArrayLike, *, hit_s: float | None) -> Axes:
    """Speeds of a platoon (vehicle, time), pale at the head and dark at the tail, behind the leader's (time,).

    `hit_s`: time of the first collision [s]; the time after it is shaded.
    """
    time, speeds = np.asarray(time), np.asarray(speeds)
    shades = mpl.colormaps["viridis_r"](np.linspace(0.1, 0.95, len(speeds)))
    for i, (speed, colour) in enumerate(zip(speeds, shades, strict=True)):
        label = f"vehicle {i + 1}" if i in (0, len(speeds) - 1) else None
        ax.plot(time, speed, color=colour, linewidth=0.9, label=label)
    ax.plot(time, np.asarray(leader), color=BLACK, linewidth=1.3, linestyle="--", label="leader")
    if hit_s is not None:
        ax.axvspan(hit_s, time[-1], color=GREY, alpha=0.2, linewidth=0, label="after a collision")
    ax.set_xlim(time[0], time[-1])
    ax.set_ylabel(LABELS["speed"])
    return ax


def amplitude_by_position(ax: Axes, ratios: Mapping[str, ArrayLike]) -> Axes:
    """RMS over the leader's, by vehicle (vehicle,), one line a setting."""
    for (name, values), (colour, marker) in zip(ratios.items(), _LINES, strict=False):
        v = np.asarray(values, dtype=float)
        ax.plot(np.arange(1, len(v) + 1), v, color=colour, marker=marker, markersize=4, label=name)
    ax.axhline(1.0, color=GREY, linewidth=1.0, linestyle=":")
    ax.set_yscale("log")
    ax.set_xlabel("vehicle behind the leader")
    return ax
