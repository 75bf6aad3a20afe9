"""Drawings over parameters and frequency, and figures made of them: regions, clouds of belief, gain curves."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.contour import ContourSet
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from numpy.typing import ArrayLike
from torch import Tensor

from avtorch.plots.style import (
    AMPLIFIES,
    BLACK,
    BLUE,
    GREY,
    LABELS,
    ORANGE,
    PURPLE,
    STABLE,
    UNSTABLE,
    VERMILLION,
    styled,
)
from avtorch.vehicle import LowerLevel, stability

_VERDICT = ("_unstable", "_amplifies", "_string stable")
"""Labels of a map's areas; legends leave out what begins with an underscore."""
_LABEL_FROM_EDGE = 0.08
"""Of an axis: a label nearer to its end would be cut off."""


def verdict_map(
    ax: Axes, x: ArrayLike, y: ArrayLike, local: ArrayLike, string: ArrayLike, peak: ArrayLike | None = None
) -> Axes:
    """Where a loop is string stable, where it only is locally stable and amplifies, where it is unstable; masks (y, x).

    Contours inside the amplifying part give the peak gain.
    """
    x, y, local, string = (np.asarray(v) for v in (x, y, local, string))
    # areas and no raster: a page that loads nothing shows no image, and areas take its colours
    local = local | string
    if not local.all():
        ax.axvspan(x[0], x[-1], color=UNSTABLE, linewidth=0, zorder=0, label=_VERDICT[0])
    if (local & ~string).any():
        ax.contourf(x, y, local.astype(float), levels=[0.5, 1.5], colors=AMPLIFIES, zorder=0.5).set_label(_VERDICT[1])
    if string.any():
        ax.contourf(x, y, string.astype(float), levels=[0.5, 1.5], colors=STABLE, zorder=0.6).set_label(_VERDICT[2])
    for mask, style in ((string, "-"), (local, "--")):
        if mask.any() and not mask.all():
            ax.contour(x, y, mask.astype(float), levels=[0.5], colors=BLACK, linewidths=1.1, linestyles=style)
    if peak is not None:
        gain = np.asarray(peak, dtype=float)
        finite = gain[np.isfinite(gain)]
        levels = [level for level in (1.1, 1.25, 1.5, 2.0, 3.0) if (finite < level).any() and (finite > level).any()]
        if levels:
            # inf outside the stable part would end the contours one cell early
            gain = np.where(np.isfinite(gain), gain, np.nan)
            lines = ax.contour(x, y, gain, levels=levels, colors="#B07A1E", linewidths=0.7)
            ax.clabel(lines, fmt=lambda g: f"{g:g}", fontsize=8, manual=_inside(lines, x, y))
    ax.grid(False)
    ax.set_xlim(x[0], x[-1])
    ax.set_ylim(y[0], y[-1])
    return ax


def _inside(lines: ContourSet, x: np.ndarray, y: np.ndarray) -> list[tuple[float, float]]:
    """Where each line is labelled: halfway along what lies well inside the axes; nowhere if it keeps to an edge."""
    low, high = np.array([x[0], y[0]], dtype=float), np.array([x[-1], y[-1]], dtype=float)
    edge = _LABEL_FROM_EDGE * (high - low)
    places = []
    for segments in lines.allsegs:
        points = np.concatenate(segments) if segments else np.zeros((0, 2))
        points = points[((points > low + edge) & (points < high - edge)).all(1)]
        if len(points):
            places.append((float(points[len(points) // 2, 0]), float(points[len(points) // 2, 1])))
    return places


def region(ax: Axes, plane: stability.Region, *, point: tuple[float, float] | None = None) -> Axes:
    """A `stability.Region`, with the setting asked about as a point in it.

    Example:
        >>> import torch
        >>> from matplotlib.figure import Figure
        >>> from avtorch import stability
        >>> from avtorch.plots import region
        >>> plane = stability.region(("T", torch.linspace(0.1, 2, 21)), ("K", torch.linspace(0.2, 1.3, 11)))
        >>> region(Figure().subplots(), plane, point=(0.3, 1.0)).get_xlabel()
        'actuation lag $T_L$ [s]'
    """
    verdict_map(ax, plane.x, plane.y, plane.local, plane.string, plane.peak_gain)
    if point is not None:
        ax.plot(*point, "o", markersize=9, color=BLUE, markeredgecolor="white", markeredgewidth=1.5)
    ax.set(xlabel=LABELS[plane.x_name], ylabel=LABELS[plane.y_name])
    return ax


def setting_region(
    ax: Axes,
    setting: Mapping[str, Any],
    *,
    T_range: tuple[float, float],
    K_range: tuple[float, float],
    clouds: Mapping[str, tuple[ArrayLike, ArrayLike]],
    truth: tuple[float, float] | None,
    points: int,
) -> Axes:
    """The vehicles `(T_L, K_L)` that a setting, in the form of an answer, keeps string stable.

    The lower level's inversion is taken into account: the verdict on a vehicle is that on its effective lag and gain.
    `clouds`: draws `(T_L, K_L)` of the belief, by the name of the moment; the last one is drawn strongest.
    """
    T = torch.linspace(*T_range, points, dtype=torch.float64)
    K = torch.linspace(*K_range, points, dtype=torch.float64)
    law = loop_of(setting, T[None, :], K[:, None])
    verdict_map(ax, T, K, stability.local_stable(*law), stability.string_stable(*law), stability.peak_gain(*law))
    # by shape as well as by colour: in grey they are the same
    looks = [(GREY, "^", 2), (PURPLE, "x", 3), (BLUE, ".", 3)]
    for (name, (t, k)), (colour, marker, size) in zip(clouds.items(), looks[-len(clouds) :], strict=False):
        look = {"marker": marker, "markersize": size, "color": colour, "alpha": 0.4}
        ax.plot(np.asarray(t), np.asarray(k), linestyle="none", label=name, zorder=3, **look)
    if truth is not None:
        ax.plot(*truth, "P", color=BLACK, markersize=9, markeredgecolor="white", label="truth", zorder=4)
    ax.set(xlabel=LABELS["T_L"], ylabel=LABELS["K_L"])
    return ax


def loop_of(setting: Mapping[str, Any], T: Tensor, K: Tensor) -> tuple[Tensor, Tensor, float, Sequence[float]]:
    """What `avtorch.stability` takes of vehicles `T` [s], `K` [-] (...,) under a setting in the form of an answer:
    lag and gain behind the lower level, time gap [s], gains."""
    lower = LowerLevel(setting["T_hat"], setting["K_hat"], setting.get("T_d", 0.3), setting.get("K_d", 1.0))
    return (*lower.effective(T, K), setting["time_gap_s"], setting["gains"])


def gain_curve(ax: Axes, omega: ArrayLike, gain: ArrayLike, *, peak: tuple[float, float] | None = None) -> Axes:
    """`|G(jω)|` from the leader's speed to the follower's over frequency [rad/s]; above one, disturbances grow.

    Example:
        >>> import torch
        >>> from matplotlib.figure import Figure
        >>> from avtorch import stability
        >>> from avtorch.plots import gain_curve
        >>> omega = torch.logspace(-1, 1, 50)
        >>> size = stability.gain(omega, 1.5, 0.5, 1.0, (1.5, 1.5, -0.8))
        >>> gain_curve(Figure().subplots(), omega, size).get_xscale()
        'log'
    """
    omega, gain = np.asarray(omega), np.asarray(gain)
    ax.fill_between(omega, 1.0, gain, where=gain > 1, color=ORANGE, alpha=0.3, linewidth=0)
    ax.axhline(1.0, color=GREY, linewidth=1.0, linestyle=":")
    ax.plot(omega, gain, color=BLUE)
    if peak is not None and np.isfinite(peak[1]) and peak[0] > 0:
        ax.plot(*peak, marker="o", color=VERMILLION, markersize=7, markeredgecolor="white")
        text = f"{peak[1]:.4g} at {peak[0]:.3g} rad/s"
        ax.annotate(text, peak, (8, 4), textcoords="offset points", color=VERMILLION, fontsize=9)
    ax.set(xscale="log", xlabel="frequency ω [rad/s]", ylabel="|G(jω)| [-]")
    ax.set(xlim=(omega[0], omega[-1]), ylim=(0, max(1.25, 1.15 * float(gain.max()))))
    return ax


def verdict_legend(ax: Axes) -> Axes:
    """Name the colours of the verdict map in `ax`, and whatever else it labels, below it.

    Axes without a map have all three named.

    Example:
        >>> from matplotlib.figure import Figure
        >>> from avtorch.plots import verdict_legend
        >>> [text.get_text() for text in verdict_legend(Figure().subplots()).get_legend().get_texts()]
        ['string stable', 'stable, amplifies (lines: peak gain)', 'unstable']
    """
    ax.legend(handles=_handles([ax]), loc="upper center", bbox_to_anchor=(0.5, -0.16), ncols=2, fontsize=8.5)
    return ax


def _handles(axes: Sequence[Axes]) -> list[Any]:
    """Of a legend: the areas of the maps in all axes, and the points that the first labels."""
    labels = {str(drawn.get_label()) for ax in axes for drawn in (*ax.collections, *ax.patches)}
    there = {kind for kind, label in enumerate(_VERDICT) if label in labels} or {0, 1, 2}
    names = {
        2: (STABLE, "string stable"),
        1: (AMPLIFIES, "stable, amplifies (lines: peak gain)"),
        0: (UNSTABLE, "unstable"),
    }
    handles: list[Any] = [
        Patch(facecolor=colour, edgecolor=GREY, label=name) for kind, (colour, name) in names.items() if kind in there
    ]
    for drawn, label in zip(*axes[0].get_legend_handles_labels(), strict=True):
        if isinstance(drawn, Line2D):
            # larger and without the cloud's transparency
            look: Any = {"color": drawn.get_color(), "marker": drawn.get_marker(), "linestyle": "none"}
            handles.append(Line2D([], [], label=label, markersize=6 if drawn.get_marker() == "x" else 8, **look))
    return handles


# figures -------------------------------------------------------------------------------------------------------------
@styled
def region_figure(
    settings: Sequence[tuple[str, Mapping[str, Any]]],
    clouds: Mapping[str, tuple[ArrayLike, ArrayLike]],
    *,
    truth: tuple[float, float] | None = None,
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
    drawn = [*clouds.values(), *([] if truth is None else [([truth[0]], [truth[1]])])]
    t, k = (np.concatenate([np.asarray(each[i]) for each in drawn]) for i in (0, 1))
    # a few far draws of a broad belief must not squeeze the rest into a corner
    T_range = (0.02, max(1.0, 1.25 * float(np.quantile(t, 0.99)), 1.25 * (truth[0] if truth else 0.0)))
    K_range = (min(0.25, 0.8 * float(np.quantile(k, 0.01))), max(1.3, 1.15 * float(np.quantile(k, 0.99))))
    count = len(settings)
    figure = Figure(figsize=(4.9 * count + 0.4, 5.2), layout="constrained")
    axes = figure.subplots(1, count, sharex=True, sharey=True, squeeze=False)[0]
    for ax, (title, setting) in zip(axes, settings, strict=True):
        setting_region(ax, setting, T_range=T_range, K_range=K_range, clouds=clouds, truth=truth, points=points)
        ax.set_title(title)
        ax.label_outer()
    figure.legend(handles=_handles(list(axes)), loc="outside lower center", ncols=3, fontsize=8.5)
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
    verdict_legend(region(left, plane, point=point))
    gain_curve(right, omega, gain, peak=peak)
    left.set_title("Region")
    right.set_title("Leader's speed to follower's")
    if not stable:
        right.text(0.02, 0.97, "locally unstable: formal only", transform=right.transAxes, va="top", color=VERMILLION)
    if title:
        figure.suptitle(title, fontsize=10, color=GREY)
    return figure
