"""The paper's experiments, rerun: drawings, and the pictures of `avtorch paper`."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import matplotlib as mpl
import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from numpy.typing import ArrayLike

from avtorch.paper.drive import ACT_S, CHANGE_S, CHANGED, HEALTHY, rows_from
from avtorch.paper.estimation import LAGS, Estimation
from avtorch.paper.gains import FACTORS, NAMES, Gains
from avtorch.paper.monitoring import Monitoring, Watched
from avtorch.paper.platoon import PASSED_S, Platoon
from avtorch.paper.regions import CASES, FORMS, Regions
from avtorch.paper.rows import middle
from avtorch.paper.strategies import AS_BUILT, Driven, Strategies
from avtorch.plots.plane import verdict_map
from avtorch.plots.style import (
    AMPLIFIES,
    BLACK,
    BLUE,
    GREEN,
    GREY,
    LABELS,
    ORANGE,
    PURPLE,
    SKY,
    STABLE,
    UNSTABLE,
    VERMILLION,
    legend,
    short,
    styled,
)
from avtorch.plots.time import belief_band, events, motion
from avtorch.vehicle import stability

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


# figures -------------------------------------------------------------------------------------------------------------
_FORMS = {
    "print": "as printed",
    "rigorous": "Eqs. 2, 3, rigorous",
    "exact": "every vehicle, exact",
    "posterior": "belief, P ≥ 0.95",
}

# the panel of a strategy, and what is drawn in it beside no action
_PANELS = {
    "Strategy 1": {"with": "Strategy 1 as printed", "ours": "our strategist, Strategy 1"},
    "Strategy 2, time gap": {
        "upper": "Strategy 2 as printed, upper level only",
        "with": "Strategy 2 as printed, with the lower level",
        "ours": "our strategist, Strategies 1 and 2",
    },
    "Strategy 3, gains": {
        "upper": "Strategy 3 as printed, upper level only",
        "with": "Strategy 3 as printed, with the lower level",
        "ours": "our strategist, Strategies 1 and 3",
    },
    "All strategies": {"ours": "our strategist, all strategies"},
}
SHOWN_S = 20.0
"""From when on the strategies' drives are drawn [s]."""

_KINDS = {
    "upper": "as printed, upper level only",
    "with": "as printed, with the lower level",
    "ours": "our strategist",
}


def paper_pictures(found: Mapping[str, Any]) -> dict[str, Callable[[], Figure]]:
    """File name to figure, of the experiments found (`Reproduction.found`).

    Example:
        >>> from avtorch.paper import reproduce
        >>> from avtorch.plots import paper_pictures
        >>> sorted(paper_pictures(reproduce(["gains"], seeds=2).found))
        ['gains.png']
    """
    pictures: dict[str, Callable[[], Figure]] = {}
    for name, one in found.items():
        if name == "strategies":
            for part, draw in _STRATEGIES.items():
                pictures[f"strategies_{part}.png"] = lambda one=one, draw=draw: draw(one)
        else:
            pictures[f"{name}.png"] = lambda one=one, draw=_DRAWN[name]: draw(one)
    return pictures


@styled
def regions_figure(found: Regions) -> Figure:
    """Four panels of the paper down, four ways to draw a region across; the plane of k_v and k_a at k_s = 1.5."""
    figure = Figure(figsize=(11, 11.6), layout="constrained")
    axes = figure.subplots(len(CASES), len(FORMS), sharex=True, sharey=True)
    for row, case, local, string, shares in zip(axes, CASES, found.local, found.string, found.shares, strict=True):
        for ax, form in zip(row, FORMS, strict=True):
            verdict_map(ax, found.k_v, found.k_a, local[form], string[form])
            ax.plot(1.5, -0.8, marker="o", color=BLUE, markeredgecolor="white", markersize=7)
            ax.set_title(f"{case.title}: {100 * float(middle(shares[form])):.0f} %", fontsize=9)
            if ax in axes[-1]:
                ax.set_xlabel(LABELS["k_v"])
        row[0].set_ylabel(LABELS["k_a"])
    for ax, form in zip(axes[0], FORMS, strict=True):
        ax.set_title(f"{_FORMS[form]}\n{ax.get_title(loc='left')}", fontsize=9)
    colours = {"locally and string stable": STABLE, "locally stable only": AMPLIFIES, "not locally stable": UNSTABLE}
    patches = [Patch(facecolor=colour, edgecolor=GREY, label=text) for text, colour in colours.items()]
    figure.legend(handles=patches, loc="outside lower center", ncols=3)
    figure.suptitle("% : stable share of the box of all three gains; dot: the default gains", fontsize=9, color=GREY)
    return figure


@styled
def estimation_figure(found: Estimation) -> Figure:
    """Estimates over both sweeps behind every leader, and the error along them."""
    count = len(found.sweeps)
    figure = Figure(figsize=(11, 3.4 * count + 3.6), layout="constrained")
    grid = figure.add_gridspec(count + 1, 6)
    first = None
    for i, sweep in enumerate(found.sweeps):
        for j, (name, part) in enumerate((("T_L", slice(0, len(LAGS))), ("K_L", slice(len(LAGS), None)))):
            ax = figure.add_subplot(grid[i, 3 * j : 3 * j + 3])
            tracked(ax, sweep.truth[part, j], *(x[part, :, j] for x in (sweep.mean, sweep.q05, sweep.q95)), name=name)
            if j == 0:
                ax.set_title(f"Behind {sweep.ahead.name}", fontsize=10)
            first = ax if first is None else first
    lags, gains = slice(0, len(LAGS)), slice(len(LAGS), None)
    for k, (of, along, part) in enumerate((("T_L", "T_L", lags), ("K_L", "K_L", gains), ("T_L", "K_L", gains))):
        ax = figure.add_subplot(grid[count, 2 * k : 2 * k + 2])
        column, swept = ("T_L", "K_L").index(of), ("T_L", "K_L").index(along)
        errors = {s.ahead.name: s.error[part, :, column] for s in found.sweeps}
        error_growth(ax, found.sweeps[0].truth[part, swept], errors, along=along, of=of)
        if k == 0:
            ax.legend()
    assert first is not None
    first.legend(loc="upper left")
    return figure


@styled
def monitoring_figure(found: Monitoring) -> Figure:
    """Accelerations and the belief of the first run behind every leader, alerts marked."""
    count = len(found.watched)
    figure = Figure(figsize=(5.6 * count + 0.4 if count > 1 else 9, 7.2), layout="constrained")
    axes = figure.subplots(3, count, sharex=True, squeeze=False)
    for column, one in zip(axes.T, found.watched, strict=True):
        alerts = one.run.alerts[0][:1]
        for ax in column:
            events(ax, change_s=CHANGE_S, alerts=[{"time_s": a.time_s} for a in alerts])
        run = one.run.rows
        traces = {"leader": run.lead_accel[0], "without action": run.accel[0]}
        motion(column[0], run.time, traces, quantity="accel")
        for ax, (i, name) in zip(column[1:], enumerate(("T_L", "K_L")), strict=True):
            truth = [(0.0, HEALTHY[i]), (CHANGE_S, CHANGED[i])]
            belief_band(ax, _windows(one), name, truth=truth)
        column[0].set_title(one.ahead.name, fontsize=9)
        column[-1].set_xlabel("time [s]")
    legend(figure, axes.ravel(), where="lower center", columns=4)
    return figure


@styled
def strategy_figure(found: Strategies, quantity: str) -> Figure:
    """Accelerations or speeds of the first run under every strategy, as printed and as our strategist chose."""
    figure = Figure(figsize=(10, 9.6), layout="constrained")
    axes = figure.subplots(len(_PANELS), 1, sharex=True, sharey=True)
    drives = {name: rows_from(one.run, SHOWN_S) for name, one in found.driven.items()}
    base = drives[AS_BUILT]
    for ax, (title, drawn) in zip(axes, _PANELS.items(), strict=True):
        events(ax, change_s=CHANGE_S, actions=[{"time_s": ACT_S}])
        traces = {"leader": getattr(base, f"lead_{quantity}")[0], "no action": getattr(base, quantity)[0]}
        traces |= {_KINDS[kind]: getattr(drives[name], quantity)[0] for kind, name in drawn.items()}
        setting_traces(ax, base.time, traces, quantity=quantity)
        ax.set_title(title)
    axes[-1].set_xlabel("time [s]")
    legend(figure, axes, where="lower center", columns=4)
    return figure


@styled
def strategy_verdict_figure(found: Strategies) -> Figure:
    """Not in the paper: |G(jω)| at the true vehicle under every setting (ours: the first run's last)."""
    figure = Figure(figsize=(11, 4.4), layout="constrained")
    axes = figure.subplots(1, len(_PANELS), sharey=True)
    omega = torch.logspace(-2, 1.3, 300, dtype=torch.float64)
    for ax, (title, drawn) in zip(axes, _PANELS.items(), strict=True):
        names = {"no action": AS_BUILT, **{_KINDS[kind]: name for kind, name in drawn.items()}}
        curves = {kind: _gain(omega, found.driven[name]) for kind, name in names.items()}
        setting_gains(ax, omega, curves)
        peaks = "\n".join(f"{float(found.driven[name].peak[0]):.3f}  {kind}" for kind, name in names.items())
        ax.text(0.98, 0.98, peaks, transform=ax.transAxes, ha="right", va="top", fontsize=7)
        ax.set_title(title)
    axes[0].set_ylabel("|G(jω)| at the true vehicle [-]")
    axes[0].set_ylim(0.0, 3.2)
    legend(figure, axes, where="lower center", columns=4)
    return figure


@styled
def gains_figure(found: Gains) -> Figure:
    """Every measure against each gain in turn, relative to the default."""
    figure = Figure(figsize=(11, 4.2), layout="constrained")
    axes = figure.subplots(1, len(NAMES), sharey=True)
    for i, (ax, name) in enumerate(zip(axes, NAMES, strict=True)):
        measured = {what: middle(values[i]) for what, values in found.measured.items()}
        measured["peak gain, changed vehicle"] = found.peak[i]
        gain_effects(ax, FACTORS, measured, gain=name)
    axes[0].set_ylabel("relative to the default [-]")
    axes[0].set_yscale("log")
    axes[0].set_yticks([0.3, 0.5, 0.7, 1.0, 1.5, 2.0, 3.0, 5.0], ["0.3", "0.5", "0.7", "1", "1.5", "2", "3", "5"])
    axes[0].minorticks_off()
    legend(figure, axes, where="lower center", columns=4)
    return figure


@styled
def platoon_figure(found: Platoon) -> Figure:
    """Speeds of the first run's platoons, and RMS speed and acceleration from vehicle to vehicle."""
    platoons = [i for i, name in enumerate(found.names) if not name.endswith("with the lower level")]
    figure = Figure(figsize=(11, 2.2 * len(platoons) + 3.8), layout="constrained")
    grid = figure.add_gridspec(len(platoons) + 1, 2, height_ratios=[1.0] * len(platoons) + [1.5])
    first: Axes | None = None
    panels: list[Axes] = []
    run = found.run
    for row, i in enumerate(platoons):
        ax = figure.add_subplot(grid[row, :], sharex=first)
        first = ax if first is None else first
        hit = torch.nonzero((run.spacing[i, 0] <= 0).any(0))
        hit_s = float(run.time[hit[0, 0]]) if len(hit) else None
        events(ax, change_s=CHANGE_S, actions=[] if i == 0 else [{"time_s": ACT_S}])
        platoon_speeds(ax, run.time, run.lead_speed[i, 0, 0], run.speed[i, 0], hit_s=hit_s)
        ax.set_title(f"{found.names[i]}: peak gain {float(found.peak[i]):.3f}", fontsize=10)
        panels.append(ax)
        ax.tick_params(labelbottom=i == platoons[-1])
    panels[-1].set_xlabel("time [s]")
    for column, what in enumerate(("speed", "accel")):
        ax = figure.add_subplot(grid[len(platoons), column])
        ratios = middle(found.against_leader(what, PASSED_S), 1)
        amplitude_by_position(ax, {name: ratios[i] for i, name in enumerate(found.names)})
        word = "speed about its mean" if what == "speed" else "acceleration"
        ax.set_ylabel(f"RMS of the {word}\nover the leader's [-]")
        ax.set_title(f"From {PASSED_S:g} s on", fontsize=10)
        panels.append(ax)
    legend(figure, panels, where="lower center", columns=3)
    return figure


_DRAWN: Mapping[str, Callable[[Any], Figure]] = {
    "regions": regions_figure,
    "estimation": estimation_figure,
    "monitoring": monitoring_figure,
    "gains": gains_figure,
    "platoon": platoon_figure,
}

_STRATEGIES: Mapping[str, Callable[[Strategies], Figure]] = {
    "acceleration": lambda one: strategy_figure(one, "accel"),
    "speed": lambda one: strategy_figure(one, "speed"),
    "verdict": lambda one: strategy_verdict_figure(one),
}


PAPER_PICTURES = (*(f"{name}.png" for name in _DRAWN), *(f"strategies_{x}.png" for x in _STRATEGIES))
"""Every file that `paper_pictures` may name."""


def _windows(one: Watched, scenario: int = 0) -> list[dict[str, Any]]:
    """The first run's windows, as `belief_band` takes them."""
    out = []
    for w, used in zip(one.run.windows, one.used[:, scenario].tolist(), strict=True):
        stats = {name: w.window.belief.stat(name, scenario) for name in ("T_L", "K_L")}
        out.append({"start_s": w.window.start_s, "end_s": w.window.end_s, "used": used, "excited": used, **stats})
    return out


def _gain(omega: torch.Tensor, one: Driven) -> np.ndarray:
    s = one.last[:1]
    T, K = s.lower_level().effective(*(torch.tensor([x], dtype=torch.float64) for x in CHANGED))
    return stability.gain(omega, T, K, s.time_gap, s.gains).reshape(-1).numpy()
