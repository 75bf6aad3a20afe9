"""The paper's experiments, rerun: the pictures of `avtorch paper`."""

from __future__ import annotations

from collections.abc import Callable, Mapping
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

_UPPER, _BOTH, _OURS = "as printed, upper level only", "as printed, with the lower level", "our strategist"
#: One colour a kind of setting, here and in every picture of strategies.
SETTINGS: dict[str, dict[str, Any]] = {
    "leader": {"color": GREY, "linewidth": 1.1},
    "no action": {"color": VERMILLION, "linewidth": 1.2},
    _UPPER: {"color": ORANGE, "linewidth": 1.3},
    _BOTH: {"color": PURPLE, "linewidth": 1.3},
    _OURS: {"color": BLUE, "linewidth": 1.7},
}

_LINES = ((BLUE, "o"), (ORANGE, "s"), (PURPLE, "^"), (GREEN, "D"), (VERMILLION, "v"), (SKY, "P"), (BLACK, "X"))


def _lines(ax: Axes, x: ArrayLike, named: Mapping[str, ArrayLike]) -> None:
    """A marked line each, by label."""
    for (name, values), (colour, marker) in zip(named.items(), _LINES, strict=False):
        ax.plot(np.asarray(x), np.asarray(values), color=colour, marker=marker, markersize=4, label=name)


def _settings(ax: Axes, x: ArrayLike, named: Mapping[str, ArrayLike]) -> None:
    """A line each, by names of `SETTINGS`, over the whole axis."""
    for name, values in named.items():
        ax.plot(np.asarray(x), np.asarray(values), label=name, **SETTINGS[name])
    ax.set_xlim(np.asarray(x)[0], np.asarray(x)[-1])


def _one(ax: Axes) -> None:
    ax.axhline(1.0, color=GREY, linewidth=1.0, linestyle=":")


def _tracked(ax: Axes, truth: ArrayLike, mean: ArrayLike, low: ArrayLike, high: ArrayLike, *, name: str) -> None:
    """Estimates against the truth (setting,): one mark and one 90 % interval a run (setting, run), and the diagonal.

    Runs of one setting stand side by side, a little apart.
    """
    x, m, lo, hi = (np.asarray(v, dtype=float) for v in (truth, mean, low, high))
    nearest = np.diff(np.unique(x)).min()
    at = x[:, None] + 0.6 * nearest * np.linspace(-0.5, 0.5, m.shape[1])
    ax.plot([x.min(), x.max()], [x.min(), x.max()], color=BLACK, linestyle="--", linewidth=1.0, label="truth", zorder=1)
    ax.vlines(at.ravel(), lo.ravel(), hi.ravel(), color=BLUE, alpha=0.55, linewidth=1.1, label="90 % interval, a run")
    ax.plot(at.ravel(), m.ravel(), ".", color=BLUE, markersize=3, label="mean")
    ax.set(xlabel=f"true {LABELS[name]}", ylabel=f"estimated {short(name)} [{_UNITS[name]}]")


def _errors(ax: Axes, x: ArrayLike, errors: Mapping[str, ArrayLike], *, along: str, of: str) -> None:
    """Absolute errors (setting, run) over the swept parameter, log-log: median, and the central 90 % of the runs."""
    quantiles = {
        name: np.quantile(np.maximum(np.asarray(values, dtype=float), 1e-9), [0.05, 0.5, 0.95], axis=-1)
        for name, values in errors.items()
    }
    for (low, _, high), (colour, _) in zip(quantiles.values(), _LINES, strict=False):
        ax.fill_between(x, low, high, color=colour, alpha=0.15, linewidth=0)
    _lines(ax, x, {name: middle for name, (_, middle, _) in quantiles.items()})
    ax.set(xscale="log", yscale="log", xlabel=f"true {LABELS[along]}", ylabel=f"error of {short(of)} [{_UNITS[of]}]")
    ax.set_xticks(x, [f"{t:g}" for t in np.asarray(x)])
    ax.minorticks_off()


_UNITS = {"T_L": "s", "K_L": "-"}
_FORMS = {
    "print": "as printed",
    "rigorous": "Eqs. 2, 3, rigorous",
    "exact": "every vehicle, exact",
    "posterior": "belief, P ≥ 0.95",
}

# the panel of a strategy, and what is drawn in it beside no action
_PANELS = {
    "Strategy 1": {_BOTH: "Strategy 1 as printed", _OURS: "our strategist, Strategy 1"},
    "Strategy 2, time gap": {
        _UPPER: "Strategy 2 as printed, upper level only",
        _BOTH: "Strategy 2 as printed, with the lower level",
        _OURS: "our strategist, Strategies 1 and 2",
    },
    "Strategy 3, gains": {
        _UPPER: "Strategy 3 as printed, upper level only",
        _BOTH: "Strategy 3 as printed, with the lower level",
        _OURS: "our strategist, Strategies 1 and 3",
    },
    "All strategies": {_OURS: "our strategist, all strategies"},
}
SHOWN_S = 20.0
"""From when on the strategies' drives are drawn [s]."""


def paper_pictures(found: Mapping[str, Any]) -> dict[str, Callable[[], Figure]]:
    """File name to figure, of the experiments found (`Reproduction.found`).

    Example:
        >>> from avtorch.paper import reproduce
        >>> from avtorch.plots import paper_pictures
        >>> sorted(paper_pictures(reproduce(["gains"], seeds=2).found))
        ['gains.png']
    """
    return {
        file: lambda one=found[name], draw=draw: draw(one)
        for name in found
        for file, (of, draw) in _DRAWN.items()
        if of == name
    }


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
    names, count = ("T_L", "K_L"), len(found.sweeps)
    swept = (slice(0, len(LAGS)), slice(len(LAGS), None))  # settings in which the lag varies, and the gain
    figure = Figure(figsize=(11, 3.4 * count + 3.6), layout="constrained")
    grid = figure.add_gridspec(count + 1, 6)
    for i, sweep in enumerate(found.sweeps):
        for j, (name, part) in enumerate(zip(names, swept, strict=True)):
            ax = figure.add_subplot(grid[i, 3 * j : 3 * j + 3])
            _tracked(ax, sweep.truth[part, j], *(x[part, :, j] for x in (sweep.mean, sweep.q05, sweep.q95)), name=name)
            if j == 0:
                ax.set_title(f"Behind {sweep.ahead.name}", fontsize=10)
    for k, (of, along) in enumerate(((0, 0), (1, 1), (0, 1))):
        ax = figure.add_subplot(grid[count, 2 * k : 2 * k + 2])
        errors = {s.ahead.name: s.error[swept[along], :, of] for s in found.sweeps}
        _errors(ax, found.sweeps[0].truth[swept[along], along], errors, along=names[along], of=names[of])
    figure.axes[0].legend(loc="upper left")
    figure.axes[2 * count].legend()
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
        traces |= {kind: getattr(drives[name], quantity)[0] for kind, name in drawn.items()}
        _settings(ax, base.time, traces)
        ax.set_ylabel(LABELS[quantity])
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
        names = {"no action": AS_BUILT, **drawn}
        _one(ax)
        _settings(ax, omega, {kind: _gain(omega, found.driven[name]) for kind, name in names.items()})
        ax.set(xscale="log", xlabel="frequency ω [rad/s]")
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
        _lines(ax, FACTORS, {what: np.asarray(x) / float(x[0]) for what, x in measured.items()})
        _one(ax)
        ax.set_xlabel(f"${name}$, times its default")
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
    run = found.run
    for row, i in enumerate(platoons):
        ax = figure.add_subplot(grid[row, :], sharex=figure.axes[0] if row else None)
        hit = torch.nonzero((run.spacing[i, 0] <= 0).any(0))
        events(ax, change_s=CHANGE_S, actions=[] if i == 0 else [{"time_s": ACT_S}])
        shades = mpl.colormaps["viridis_r"](np.linspace(0.1, 0.95, len(run.speed[i, 0])))
        for k, (speed, colour) in enumerate(zip(run.speed[i, 0], shades, strict=True)):
            label = f"vehicle {k + 1}" if k in (0, len(shades) - 1) else None
            ax.plot(run.time, speed, color=colour, linewidth=0.9, label=label)
        ax.plot(run.time, run.lead_speed[i, 0, 0], color=BLACK, linewidth=1.3, linestyle="--", label="leader")
        if len(hit):
            hit_s, end_s = float(run.time[hit[0, 0]]), float(run.time[-1])
            ax.axvspan(hit_s, end_s, color=GREY, alpha=0.2, linewidth=0, label="after a collision")
        ax.set_xlim(float(run.time[0]), float(run.time[-1]))
        ax.set_ylabel(LABELS["speed"])
        ax.set_title(f"{found.names[i]}: peak gain {float(found.peak[i]):.3f}", fontsize=10)
        ax.tick_params(labelbottom=i == platoons[-1])
    figure.axes[-1].set_xlabel("time [s]")
    for column, what in enumerate(("speed", "accel")):
        ax = figure.add_subplot(grid[len(platoons), column])
        ratios = middle(found.against_leader(what, PASSED_S), 1)
        _lines(ax, np.arange(1, len(ratios[0]) + 1), {name: ratios[i] for i, name in enumerate(found.names)})
        _one(ax)
        ax.set(yscale="log", xlabel="vehicle behind the leader")
        word = "speed about its mean" if what == "speed" else "acceleration"
        ax.set_ylabel(f"RMS of the {word}\nover the leader's [-]")
        ax.set_title(f"From {PASSED_S:g} s on", fontsize=10)
    legend(figure, figure.axes, where="lower center", columns=3)
    return figure


_DRAWN: Mapping[str, tuple[str, Callable[[Any], Figure]]] = {
    "regions.png": ("regions", regions_figure),
    "estimation.png": ("estimation", estimation_figure),
    "monitoring.png": ("monitoring", monitoring_figure),
    "gains.png": ("gains", gains_figure),
    "platoon.png": ("platoon", platoon_figure),
    "strategies_acceleration.png": ("strategies", lambda one: strategy_figure(one, "accel")),
    "strategies_speed.png": ("strategies", lambda one: strategy_figure(one, "speed")),
    "strategies_verdict.png": ("strategies", strategy_verdict_figure),
}
"""By file: the experiment, and what draws it."""


def _windows(one: Watched) -> list[dict[str, Any]]:
    """The first run's windows, as `belief_band` takes them."""
    out = []
    for w, used in zip(one.run.windows, one.used[:, 0].tolist(), strict=True):
        stats = {name: w.window.belief.stat(name, 0) for name in ("T_L", "K_L")}
        out.append({"start_s": w.window.start_s, "end_s": w.window.end_s, "used": used, "excited": used, **stats})
    return out


def _gain(omega: torch.Tensor, one: Driven) -> np.ndarray:
    s = one.last[:1]
    T, K = s.lower_level().effective(*(torch.tensor([x], dtype=torch.float64) for x in CHANGED))
    return stability.gain(omega, T, K, s.time_gap, s.gains).reshape(-1).numpy()
