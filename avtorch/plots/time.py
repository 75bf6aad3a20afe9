"""Drawings over time, and figures made of them: motion, beliefs, events, the quality of a log."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import ArrayLike

from avtorch.io import Log
from avtorch.io.clock import from_start, time_label
from avtorch.plots.style import BLACK, BLUE, GREEN, GREY, LABELS, ORANGE, SKY, VERMILLION, legend, styled

_TRACES = {
    "leader": {"color": GREY, "linewidth": 1.2, "zorder": 2.1},
    "without action": {"color": VERMILLION, "linewidth": 1.3, "zorder": 2.2},
    "with action": {"color": BLUE, "linewidth": 1.6, "zorder": 2.3},
}

Windows = Sequence[Mapping[str, Any]]
"""Windows in the form of an answer: `start_s`, `end_s`, `excited`, `used`, `T_L`, `K_L`, `p_string_stable`, ..."""

Steps = Sequence[tuple[float, float]]
"""A quantity that jumps: `(from this time on [s], value)`."""

Motion = Mapping[str, Mapping[str, ArrayLike]]
"""Traces of a run: `{"speed": {"leader": ..., "without action": ..., "with action": ...}, "accel": {...}, ...}`."""

TARGET = 0.95
"""P(string stable) below which a setting is to be changed."""
_WIDE = 9.0  # inches
_ABOVE: Any = {"where": "upper center", "columns": 4, "last": ("vehicle changes", "alert", "action")}


def motion(ax: Axes, time: ArrayLike, traces: Mapping[str, ArrayLike], *, quantity: str = "speed") -> Axes:
    """Speeds, accelerations or spacings over time [s]; `traces` by name: leader, without action, with action."""
    for name, values in traces.items():
        ax.plot(np.asarray(time), np.asarray(values), label=name, **_TRACES.get(name, {}))
    if quantity == "spacing" and any(np.nanmin(np.asarray(values)) <= 0 for values in traces.values()):
        low, high = ax.get_ylim()
        ax.axhspan(low, 0.0, color=GREY, alpha=0.25, linewidth=0, zorder=0)
        ax.text(0.99, 0.03, "below 0: collision", transform=ax.transAxes, ha="right", color=BLACK, fontsize=8)
        ax.set_ylim(low, high)
    ax.set(ylabel=LABELS.get(quantity, quantity), xlim=np.asarray(time)[[0, -1]])
    return ax


def belief_band(
    ax: Axes, windows: Windows, name: str, *, truth: Steps | None = None, bounds: tuple[float, float] | None = None
) -> Axes:
    """The belief about one parameter: 90 % interval and mean of each window, paler where the window was not used.

    `truth`: the true value. `bounds`: the design bounds that the controller was built for.
    """
    if bounds is not None:
        look: Any = {"facecolor": "none", "edgecolor": "#BBBBBB", "hatch": "////", "linewidth": 0, "zorder": 0}
        ax.axhspan(*bounds, label="design bounds", **look)
    for used, colour, label in ((True, BLUE, "90 % interval"), (False, GREY, "carried over (window not used)")):
        x, low = _staircase(windows, name, "q05", used)
        _, high = _staircase(windows, name, "q95", used)
        _, mean = _staircase(windows, name, "mean", used)
        if np.isfinite(mean).any():
            ax.fill_between(x, low, high, color=colour, alpha=0.3 if used else 0.18, linewidth=0, label=label)
            ax.plot(x, mean, color=colour, linewidth=1.8 if used else 1.0, label="mean" if used else None)
    if truth is not None:
        x, y = zip(*truth, (windows[-1]["end_s"], truth[-1][1]), strict=True)
        ax.step(x, y, where="post", color=BLACK, linestyle="--", label="truth")
    ax.set(ylabel=LABELS.get(name, name), ylim=_reach(windows, name, truth, bounds), xlim=_ends(windows))
    return ax


def string_probability(ax: Axes, windows: Windows, *, actions: Iterable[Mapping[str, Any]] = ()) -> Axes:
    """P(string stable) of the setting in force, over time, as it could be known: from a window's end on (a dot, red
    below the target), and from an action on that of the setting it chose.
    """
    ends = [(w["end_s"], w["p_string_stable"]) for w in windows]
    chosen = [(a["time_s"], a["p_string_stable"]) for a in actions if a.get("p_string_stable") is not None]
    known = sorted([*ends, *chosen], key=lambda each: each[0])  # an action comes after the window that led to it
    x, p = (np.array(column, dtype=float) for column in zip(*known, strict=True))
    ax.fill_between(x, p, step="post", color=SKY, alpha=0.25, linewidth=0)
    ax.step(x, p, where="post", color=BLUE)
    for below, colour, size in ((False, BLUE, 3), (True, VERMILLION, 6)):
        some = [(t, value) for t, value in ends if (value < TARGET) == below]
        if some:
            ax.plot(*zip(*some, strict=True), marker="o", markersize=size, linestyle="none", color=colour, zorder=3)
    # in the legend: beside its line a label would lie over dots and alerts
    ax.axhline(TARGET, color=GREY, linestyle=(0, (1, 1.5)), linewidth=1.2, label=f"target {TARGET:g}")
    ax.set(ylabel="P(string stable) [-]", ylim=(-0.02, 1.05), xlim=_ends(windows))
    return ax


def events(
    ax: Axes,
    *,
    change_s: float | None = None,
    alerts: Iterable[Mapping[str, Any]] = (),
    actions: Iterable[Mapping[str, Any]] = (),
) -> Axes:
    """Mark the change of the vehicle, the alerts and the actions on a time axis."""
    # an action follows its alert at once: its line is broad and pale so that the thin alert on top stays visible
    for i, time in enumerate(sorted({a["time_s"] for a in alerts})):
        ax.axvline(time, color=ORANGE, alpha=0.45, linewidth=5, zorder=1.7, label=None if i else "alert")
    for i, action in enumerate(actions):
        ax.axvline(action["time_s"], color=GREEN, linewidth=1.6, zorder=1.9, label=None if i else "action")
    if change_s is not None:
        ax.axvline(change_s, color=BLACK, linestyle=":", linewidth=1.4, zorder=1.8, label="vehicle changes")
    return ax


def data_quality(ax: Axes, log: Log, windows: Windows) -> Axes:
    """Which rows of a log serve: recorded, masked (driver, standstill); and which windows were excited.

    Times are from the log's start.
    """
    step = 1 / log.rate_hz
    time = log.elapsed
    recorded = [(time[s][0], time[s][-1] - time[s][0] + step) for s in log.segments()]
    lanes = [
        ("recorded", recorded, GREY),
        ("driver in charge", _runs(log, ~log.engaged, step), VERMILLION),
        ("standstill", _runs(log, ~log.moving, step), ORANGE),
        ("excited windows", [(w["start_s"], w["end_s"] - w["start_s"]) for w in windows if w["excited"]], BLUE),
    ]
    for lane, (_, spans, colour) in enumerate(lanes):
        ax.broken_barh(spans, (lane - 0.32, 0.64), color=colour, alpha=0.75, linewidth=0)
    ax.set_yticks(range(len(lanes)), [name for name, _, _ in lanes])
    ax.set_ylim(len(lanes) - 0.4, -0.6)
    ax.grid(False, axis="y")
    ax.set_xlim(time[0], time[-1])
    return ax


def _staircase(windows: Windows, name: str, key: str, used: bool) -> tuple[np.ndarray, np.ndarray]:
    """Both ends of every window; NaN for windows of the other kind and across gaps, so that the line breaks there."""
    x: list[float] = []
    y: list[float] = []
    for w in windows:
        if x and w["start_s"] > x[-1] + 1e-6:
            x.append(x[-1])
            y.append(np.nan)
        value = w[name][key] if w["used"] == used else np.nan
        x += [w["start_s"], w["end_s"]]
        y += [value, value]
    return np.array(x), np.array(y)


def _reach(windows: Windows, name: str, truth: Steps | None, bounds: tuple[float, float] | None) -> tuple[float, float]:
    """Limits of the axis: used windows, truth and bounds in full; a broad first prior may run out of the picture."""
    used = [w for w in windows if w["used"]] or windows
    values = [*(w[name][q] for w in used for q in ("q05", "q95")), *(v for _, v in truth or ()), *(bounds or ())]
    low, high = min(values), max(values)
    pad = 0.08 * (high - low or 1.0)
    return max(0.0, low - pad), high + pad


def _runs(log: Log, mask: np.ndarray, step: float) -> list[tuple[float, float]]:
    """Spans `(start, length)` [s] of the rows where `mask` holds."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(np.int8)))
    return [
        (float(log.elapsed[a]), float(log.elapsed[b - 1] - log.elapsed[a]) + step)
        for a, b in zip(edges[::2], edges[1::2], strict=True)
    ]


def _ends(windows: Windows) -> tuple[float, float]:
    return windows[0]["start_s"], windows[-1]["end_s"]


# figures -------------------------------------------------------------------------------------------------------------
def _stack(answer: Mapping[str, Any], rows: int, height: float, **shape: Any) -> tuple[Figure, list[Axes]]:
    """Panels above one another over time from the log's start, with the events of an answer in each."""
    figure = Figure(figsize=(_WIDE, height), layout="constrained")
    axes = list(figure.subplots(rows, 1, sharex=True, squeeze=False, **shape)[:, 0])
    # of an alarm that goes on over many windows, where it begins and is acted upon
    alerts, change = [a for a, _ in begun(answer)], (answer.get("change") or {}).get("time_s")
    for ax in axes:
        events(ax, change_s=change, alerts=alerts, actions=answer.get("actions") or ())
    axes[-1].set_xlabel(time_label(answer.get("epoch_s", 0.0)))
    return figure, axes


@styled
def motion_figure(answer: Mapping[str, Any], time: ArrayLike, traces: Motion) -> Figure:
    """Speeds [m/s], accelerations [m/s²] and spacings [m] of a run with and without action, over `time` (time,) [s].

    Example:
        >>> import numpy as np
        >>> from avtorch.plots import motion_figure
        >>> time = np.arange(0.0, 10.0, 0.1)
        >>> traces = {q: {"leader": np.sin(time), "with action": np.sin(time - 1)} for q in ("speed", "accel")}
        >>> len(motion_figure({"change": {"time_s": 4.0}}, time, traces).axes)
        2
    """
    figure, axes = _stack(answer, len(traces), 2.3 * len(traces) + 0.6)
    for ax, (quantity, named) in zip(axes, traces.items(), strict=True):
        motion(ax, time, named, quantity=quantity)
    legend(figure, axes[:1], **_ABOVE)
    return figure


@styled
def belief_figure(
    answer: Mapping[str, Any], *, truth: Mapping[str, Steps] | None = None, log: Log | None = None
) -> Figure:
    """Posterior bands of T_L and K_L over time; with the `log`, the quality of its rows below them.

    `answer` is `estimates.json`, `run.json`, or what `avtorch.results` makes of their results.

    Example:
        >>> from avtorch import Leader, estimate, simulate
        >>> from avtorch.plots import belief_figure
        >>> from avtorch.results import estimates_answer
        >>> log = simulate(Leader.default(start=50.0, duration=4.0, dt=0.02)).log()
        >>> answer = estimates_answer(estimate(log, estimator="map"))
        >>> len(belief_figure(answer, log=log).axes)  # T_L, K_L, quality of the rows
        3
    """
    answer = _from_start(answer)
    heights, height = ([3, 3], 5.8) if log is None else ([3, 3, 1.3], 6.8)
    figure, axes = _stack(answer, len(heights), height, height_ratios=heights)
    for ax, name in zip(axes, ("T_L", "K_L"), strict=False):
        belief_band(ax, answer["windows"], name, truth=(truth or {}).get(name))
    if log is not None:
        data_quality(axes[-1], log, answer["windows"])
    legend(figure, axes[:2], **_ABOVE)
    return figure


@styled
def probability_figure(answer: Mapping[str, Any]) -> Figure:
    """P(string stable) over time, with alerts and actions; each action is labelled with the setting it chose.

    Example:
        >>> from avtorch import Leader, estimate, simulate
        >>> from avtorch.plots import probability_figure
        >>> from avtorch.results import estimates_answer
        >>> log = simulate(Leader.default(start=50.0, duration=4.0, dt=0.02)).log()
        >>> len(probability_figure(estimates_answer(estimate(log, estimator="map"))).axes)
        1
    """
    answer = _from_start(answer)
    actions: Sequence[Mapping[str, Any]] = answer.get("actions") or ()
    figure, (ax,) = _stack(answer, 1, 3.6)
    string_probability(ax, answer["windows"], actions=actions)
    for i, action in enumerate(actions):
        names = " + ".join(str(s) for s in action["strategies"]) or "none"
        place = action["time_s"], 0.04 + 0.09 * (i % 4)
        ax.annotate(f"strategy {names}", place, (4, 0), textcoords="offset points", color=GREEN, fontsize=9)
    legend(figure, [ax], **_ABOVE)
    return figure


@styled
def overview_figure(
    answer: Mapping[str, Any],
    time: ArrayLike,
    traces: Motion,
    *,
    truth: Mapping[str, Steps] | None = None,
    bounds: Mapping[str, tuple[float, float]] | None = None,
) -> Figure:
    """A run at one glance: acceleration, belief about lag and gain, P(string stable).

    `answer` is `run.json`, or `avtorch.results.run_answer` of a `SupervisedRun` and the same drive without action;
    `time` [s] (time,) and `traces` of `motion`. `truth`: by name, (from [s], value) pairs; `bounds`: design bounds.

    Example:
        >>> import numpy as np
        >>> from avtorch import Leader, estimate, simulate
        >>> from avtorch.plots import overview_figure
        >>> from avtorch.results import estimates_answer
        >>> log = simulate(Leader.default(start=50.0, duration=4.0, dt=0.02)).log()
        >>> answer = {**estimates_answer(estimate(log, estimator="map")), "alerts": [], "actions": []}
        >>> traces = {"accel": {"leader": log.lead_accel, "with action": log.accel}}
        >>> len(overview_figure(answer, log.elapsed, traces).axes)
        4
    """
    figure, axes = _stack(answer, 4, 8.4)
    motion(axes[0], time, traces["accel"], quantity="accel")
    for ax, name in zip(axes[1:3], ("T_L", "K_L"), strict=True):
        belief_band(ax, answer["windows"], name, truth=(truth or {}).get(name), bounds=(bounds or {}).get(name))
    string_probability(axes[3], answer["windows"], actions=answer["actions"])
    legend(figure, axes, **_ABOVE)
    return figure


def _from_start(answer: Mapping[str, Any]) -> dict[str, Any]:
    """An answer with the times of windows, alerts and actions from the log's start."""
    lists = [key for key in ("windows", "alerts", "actions") if answer.get(key)]
    return {**answer, **{key: from_start(answer[key], answer.get("epoch_s", 0.0)) for key in lists}}


def begun(answer: Mapping[str, Any]) -> list[tuple[Mapping[str, Any], int]]:
    """The alerts that begin or lead to an action, each with the number of windows in which it goes on unanswered."""
    before = {b["end_s"]: a["end_s"] for a, b in pairwise(answer.get("windows") or ())}
    answered = {a["time_s"] for a in answer.get("actions") or ()}
    found: list[tuple[Mapping[str, Any], int]] = []
    last: dict[tuple[str, float], int] = {}  # place among them, by detector and the time of the last unanswered alert
    for alert in answer.get("alerts") or ():
        name, time = alert["detector"], alert["time_s"]
        place = last.get((name, before.get(time, np.nan)))
        if place is None or time in answered:
            place = len(found)
            found.append((alert, 0))
        else:
            found[place] = (found[place][0], found[place][1] + 1)
        if time not in answered:
            last[name, time] = place
    return found
