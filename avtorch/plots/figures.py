"""The pictures that the commands write, each a figure put together from drawings.

Figures are as wide as a desk's page; with `narrow` as a phone, panels one above the other.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import ArrayLike

from avtorch.deprecation import renamed
from avtorch.io import Log
from avtorch.io.clock import from_start, time_label
from avtorch.plots.plane import gain_curve, region, setting_region, verdict_legend
from avtorch.plots.style import GREEN, GREY, VERMILLION, styled
from avtorch.plots.time import Steps, Windows, belief_band, data_quality, events, motion, string_probability
from avtorch.vehicle import stability

Motion = Mapping[str, Mapping[str, ArrayLike]]
"""Traces of a run: `{"speed": {"leader": ..., "without action": ..., "with action": ...}, "accel": {...}, ...}`."""

_WIDE, _NARROW = 9.0, 4.0  # inches


@styled
def motion_figure(answer: Mapping[str, Any], time: ArrayLike, traces: Motion, *, narrow: bool = False) -> Figure:
    """Speeds [m/s], accelerations [m/s²] and spacings [m] of a run with and without action, over `time` (time,) [s].

    Example:
        >>> import numpy as np
        >>> from avtorch.plots import motion_figure
        >>> time = np.arange(0.0, 10.0, 0.1)
        >>> traces = {q: {"leader": np.sin(time), "with action": np.sin(time - 1)} for q in ("speed", "accel")}
        >>> len(motion_figure({"change": {"time_s": 4.0}}, time, traces).axes)
        2
    """
    figure = Figure(figsize=(_width(narrow), 2.3 * len(traces) + 0.6), layout="constrained")
    axes = figure.subplots(len(traces), 1, sharex=True, squeeze=False)[:, 0]
    for ax, (quantity, named) in zip(axes, traces.items(), strict=True):
        motion(_events_of(ax, answer), time, named, quantity=quantity)
    axes[-1].set_xlabel("time [s]")
    _legend_above(figure, axes[0], narrow=narrow)
    return figure


@styled
def belief_figure(
    windows: Windows,
    *,
    answer: Mapping[str, Any] | None = None,
    truth: Mapping[str, Steps] | None = None,
    bounds: Mapping[str, tuple[float, float]] | None = None,
    log: Log | None = None,
    narrow: bool = False,
) -> Figure:
    """Posterior bands of T_L and K_L over time; with a `log`, the quality of its rows below them.

    Times are drawn from the log's start, given by the answer's `epoch_s` or the `log`.

    Example:
        >>> from avtorch import Leader, estimate, simulate
        >>> from avtorch.plots import belief_figure
        >>> from avtorch.results import estimates_answer
        >>> log = simulate(Leader.default(start=50.0, duration=4.0, dt=0.02)).log()
        >>> answer = estimates_answer(estimate(log, estimator="map"))
        >>> len(belief_figure(answer["windows"], log=log).axes)  # T_L, K_L, quality of the rows
        3
    """
    epoch_s = log.epoch_s if log is not None else (answer or {}).get("epoch_s", 0.0)
    recorded, windows, answer = windows, from_start(windows, epoch_s), _from_start(answer, epoch_s)
    rows = 2 + (log is not None)
    figure = Figure(figsize=(_width(narrow), 5.8 if log is None else 6.8), layout="constrained")
    heights = [3, 3, 1.3][:rows]
    axes = figure.subplots(rows, 1, sharex=True, height_ratios=heights)
    for ax, name in zip(axes, ("T_L", "K_L"), strict=False):
        _events_of(ax, answer or {})
        belief_band(ax, windows, name, truth=(truth or {}).get(name), bounds=(bounds or {}).get(name))
    if log is not None:
        data_quality(axes[-1], log, recorded)
    axes[-1].set_xlabel(time_label(epoch_s))
    _legend_above(figure, *axes[:2], narrow=narrow)
    return figure


@renamed(until="0.3", target="required")
@styled
def probability_figure(
    windows: Windows, *, answer: Mapping[str, Any] | None = None, required: float = 0.95, narrow: bool = False
) -> Figure:
    """P(string stable) over time, with alerts and actions; each action is labelled with the setting it chose.

    Example:
        >>> from avtorch import Leader, estimate, simulate
        >>> from avtorch.plots import probability_figure
        >>> from avtorch.results import estimates_answer
        >>> log = simulate(Leader.default(start=50.0, duration=4.0, dt=0.02)).log()
        >>> answer = estimates_answer(estimate(log, estimator="map"))
        >>> len(probability_figure(answer["windows"]).axes)
        1
    """
    epoch_s = (answer or {}).get("epoch_s", 0.0)
    windows, answer = from_start(windows, epoch_s), _from_start(answer, epoch_s)
    figure = Figure(figsize=(_width(narrow), 3.6), layout="constrained")
    ax = figure.subplots()
    string_probability(
        _events_of(ax, answer or {}), windows, required=required, actions=(answer or {}).get("actions") or ()
    )
    for i, action in enumerate((answer or {}).get("actions") or []):
        names = " + ".join(str(s) for s in action["strategies"]) or "none"
        ax.annotate(f"strategy {names}", (action["time_s"], 0.04 + 0.09 * (i % 4)), (4, 0), textcoords="offset points",
                    color=GREEN, fontsize=9)  # fmt: skip
    ax.set_xlabel(time_label(epoch_s))
    _legend_above(figure, ax, narrow=narrow)
    return figure


@styled
def region_figure(
    settings: Sequence[tuple[str, Mapping[str, Any]]],
    clouds: Mapping[str, tuple[ArrayLike, ArrayLike]],
    *,
    truth: tuple[float, float] | None = None,
    narrow: bool = False,
    points: int = 401,
) -> Figure:
    """The posterior cloud in the stability region of each named setting, side by side on the same axes.

    `clouds`: draws of T_L [s] and K_L [-], (draw,) each, by name; `truth`: the two of the true vehicle; `points` of
    the map on each axis.

    Example:
        >>> import numpy as np
        >>> from avtorch import Setting
        >>> from avtorch.plots import region_figure
        >>> settings = [(f"{gap} s", Setting(time_gap=gap).as_dict()) for gap in (1.0, 2.5)]
        >>> T_L, K_L = np.random.default_rng(0).normal([[1.5], [0.5]], 0.02, (2, 100))
        >>> len(region_figure(settings, {"now": (T_L, K_L)}, truth=(1.5, 0.5)).axes)
        2
    """
    t = np.concatenate([np.asarray(c[0]) for c in clouds.values()] + [[] if truth is None else [truth[0]]])
    k = np.concatenate([np.asarray(c[1]) for c in clouds.values()] + [[] if truth is None else [truth[1]]])
    # a few far draws of a broad belief must not squeeze the rest into a corner
    T_range = (0.02, max(1.0, 1.25 * float(np.quantile(t, 0.99)), 1.25 * (truth[0] if truth else 0.0)))
    K_range = (min(0.25, 0.8 * float(np.quantile(k, 0.01))), max(1.3, 1.15 * float(np.quantile(k, 0.99))))
    count = len(settings)
    size = (_NARROW, 3.9 * count + 0.8) if narrow else (4.9 * count + 0.4, 5.2)
    figure = Figure(figsize=size, layout="constrained")
    shape = (count, 1) if narrow else (1, count)
    axes = figure.subplots(*shape, sharex=True, sharey=True, squeeze=False).ravel()
    for ax, (title, setting) in zip(axes, settings, strict=True):
        setting_region(ax, setting, T_range=T_range, K_range=K_range, clouds=clouds, truth=truth, points=points)
        ax.set_title(title)
        ax.label_outer()
    legend = verdict_legend(axes[0], beside=list(axes[1:])).get_legend()
    assert legend is not None
    handles = legend.legend_handles
    legend.remove()
    figure.legend(
        handles=[h for h in handles if h is not None],
        loc="outside lower center",
        ncols=1 if narrow else 3,
        fontsize=8.5,
    )
    return figure


@renamed(until="0.3", target="required")
@styled
def overview_figure(
    answer: Mapping[str, Any],
    time: ArrayLike,
    traces: Motion,
    *,
    truth: Mapping[str, Steps] | None = None,
    bounds: Mapping[str, tuple[float, float]] | None = None,
    required: float = 0.95,
    narrow: bool = False,
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
    figure = Figure(figsize=(_width(narrow), 8.4), layout="constrained")
    axes = figure.subplots(4, 1, sharex=True)
    for ax in axes:
        _events_of(ax, answer)
    motion(axes[0], time, traces["accel"], quantity="accel")
    for ax, name in zip(axes[1:3], ("T_L", "K_L"), strict=True):
        belief_band(ax, answer["windows"], name, truth=(truth or {}).get(name), bounds=(bounds or {}).get(name))
    string_probability(axes[3], answer["windows"], required=required, actions=answer["actions"])
    axes[3].set_xlabel("time [s]")
    _legend_above(figure, *axes, narrow=narrow)
    return figure


@styled
def stability_figure(
    plane: stability.Region,
    point: tuple[float, float],
    omega: ArrayLike,
    gain: ArrayLike,
    *,
    peak: tuple[float, float] | None = None,
    stable: bool = True,
    title: str = "",
) -> Figure:
    """A stability region with one setting in it, beside that setting's gain over frequency.

    `omega` [rad/s] and `gain` [-] are (frequency,), `peak` the two at the peak. `stable`: the setting is
    locally stable; where it is not, the gain is only formal, and the picture is labelled so.

    Example:
        >>> import torch
        >>> from avtorch import stability
        >>> from avtorch.plots import stability_figure
        >>> plane = stability.region(("T", torch.linspace(0.1, 2, 21)), ("K", torch.linspace(0.2, 1.3, 11)))
        >>> omega = torch.logspace(-1, 1, 50)
        >>> size = stability.gain(omega, 1.5, 0.5, 1.0, (1.5, 1.5, -0.8))
        >>> len(stability_figure(plane, (1.5, 0.5), omega, size).axes)
        2
    """
    figure = Figure(figsize=(10.4, 4.8), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=[1, 1.05])
    verdict_legend(region(left, plane, point=point), extra=False)
    gain_curve(right, omega, gain, peak=peak)
    left.set_title("Region")
    right.set_title("Leader's speed to follower's")
    if not stable:
        right.text(0.02, 0.97, "locally unstable: formal only", transform=right.transAxes, va="top", color=VERMILLION)
    if title:
        figure.suptitle(title, fontsize=10, color=GREY)
    return figure


def _from_start(answer: Mapping[str, Any] | None, epoch_s: float) -> dict[str, Any]:
    """An answer with the times of windows, alerts and actions from the log's start."""
    lists = ("windows", "alerts", "actions")
    return {k: from_start(v, epoch_s) if k in lists and v else v for k, v in (answer or {}).items()}


def _events_of(ax: Axes, answer: Mapping[str, Any]) -> Axes:
    """Mark an answer's events. Of an alarm that continues over many windows, mark only the first and those acted
    upon."""
    windows = answer.get("windows") or []
    went_on = {(b["end_s"], name) for a, b in pairwise(windows) for name in set(a["alerts"]) & set(b["alerts"])}
    answered = {a["time_s"] for a in answer.get("actions") or ()}
    alerts = [
        a for a in answer.get("alerts") or () if a["time_s"] in answered or (a["time_s"], a["detector"]) not in went_on
    ]
    change = (answer.get("change") or {}).get("time_s")
    return events(ax, change_s=change, alerts=alerts, actions=answer.get("actions") or ())


def _width(narrow: bool) -> float:
    """Of a figure [in]."""
    return _NARROW if narrow else _WIDE


def _legend_above(figure: Figure, *axes: Axes, narrow: bool) -> None:
    """One legend for the figure, each name once, the events last."""
    found: dict[str, Any] = {}
    for ax in axes:
        for handle, label in zip(*ax.get_legend_handles_labels(), strict=True):
            found.setdefault(label, handle)
    last = ("vehicle changes", "alert", "action")
    names = [n for n in found if n not in last] + [n for n in last if n in found]
    figure.legend(
        [found[n] for n in names], names, loc="outside upper center", ncols=min(len(names), 2 if narrow else 4)
    )
