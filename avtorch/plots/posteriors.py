"""Posteriors and their references: drawings that take an axes and return it, and the pictures of a validation.

Each method has one style everywhere: grey and filled is exact (quadrature), blue is avtorch's SGLD, vermillion and
dashed NUTS, black the truth.
"""

from __future__ import annotations

import math
import textwrap
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any, Literal

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, MaxNLocator, NullFormatter
from numpy.typing import ArrayLike
from scipy.stats import uniform
from torch import Tensor

from avtorch.arrays import FloatArray
from avtorch.inference import Posterior, Quadrature
from avtorch.inference.arviz_export import arviz
from avtorch.plots.style import BLACK, BLUE, LABELS, VERMILLION, legend, short, styled
from avtorch.validation.agreement import MEAN_TOLERANCE, SD_TOLERANCE, sampling_diagnostics
from avtorch.validation.validate import Validation

EXACT, EXACT_FILL = "#555555", "#DADADA"
_COLOURS = {"SGLD": BLUE, "NUTS": VERMILLION, "exact": EXACT}
#: Points of a cloud at most.
SHOWN = 1500
TAIL = 5e-4
#: Most bins of a histogram.
BINS = 2000


def marginals(
    ax: Axes,
    name: str,
    sgld_draws: ArrayLike,
    nuts_draws: ArrayLike | None,
    quadrature: Quadrature | None,
    window: int = 0,
    *,
    truth: float | None = None,
) -> Axes:
    """Posterior density of one parameter of one window, in its own unit: exact as an area, draws as histograms.

    Histograms integrate to one over all their draws, also where the axis shows less of them; draws that are not finite
    are left out of the picture but not of the count.

    Args:
        sgld_draws, nuts_draws: draws of that parameter in that window, `(...)`, in its own unit.
        quadrature: exact marginals, one of whose windows is ``window``; None where there are none.
        truth: its true value, drawn as a line.

    Example:
        >>> import numpy as np
        >>> from matplotlib.figure import Figure
        >>> from avtorch.plots import marginals
        >>> draws = np.random.default_rng(0).normal(0.5, 0.02, 1000)
        >>> marginals(Figure().subplots(), "T_L", draws, None, None, truth=0.5).get_xlabel()
        'actuation lag $T_L$ [s]'
    """
    view, sd = [np.inf, -np.inf], np.nan
    if quadrature is not None:
        value, density = exact_density(quadrature, name, window)
        area = {"facecolor": EXACT_FILL, "edgecolor": EXACT, "linewidth": 1.0, "zorder": 1.5}
        ax.fill_between(value, density, label="exact (quadrature)", **area)
        view, sd = [value[0], value[-1]], float(quadrature.sd[window, quadrature.names.index(name)])
    looks = {"SGLD": {"color": BLUE, "linewidth": 1.6}, "NUTS": {"color": VERMILLION, "linewidth": 1.2, "ls": "--"}}
    for (label, look), draws in zip(looks.items(), (sgld_draws, nuts_draws), strict=True):
        if draws is None:
            continue
        found = np.asarray(draws, dtype=float).ravel()
        finite = found[np.isfinite(found)]
        if len(finite):
            # Scott's rule with the exact SD, so that the bins do not hide a wrong width
            edges = _edges(finite, 3.5 * (sd if sd > 0 else finite.std()) * len(finite) ** (-1 / 3))
            height = np.histogram(finite, edges)[0] / (len(found) * np.diff(edges))
            ax.stairs(height, edges, label=label, zorder=3 if label == "SGLD" else 3.1, **look)
            inner = finite[(finite >= edges[1]) & (finite <= edges[-2])] if len(edges) > 3 else finite
            view = [min(view[0], np.quantile(inner, 0.001)), max(view[1], np.quantile(inner, 0.999))]
    if truth is not None:
        ax.axvline(truth, color=BLACK, linestyle=":", linewidth=1.4, label="truth", zorder=2.5)
    if view[1] > view[0]:
        ax.set_xlim(*view)
    ax.set_ylim(0, None)
    ax.set_yticks([])
    ax.grid(False)
    ax.spines["left"].set_visible(False)
    ax.xaxis.set_major_locator(MaxNLocator(4))
    ax.set_xlabel(LABELS.get(name, name))
    return ax


def exact_density(quadrature: Quadrature, name: str, window: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """A marginal as a smooth curve: values in the parameter's unit and the density there, per that unit.

    The nodes' masses are band-limited, so their sinc interpolant is as exact as the grid (as in `Quadrature.cdf`). A
    mass of `TAIL` is left out at either end.
    """
    i = quadrature.names.index(name)
    nodes, mass = quadrature.nodes[window, i], quadrature.mass[window, i]
    spacing = nodes[1] - nodes[0]
    ends = torch.stack([quadrature.quantile(q)[window, i] for q in (TAIL, 1 - TAIL)]).log()
    z = ends[0] + (ends[1] - ends[0]) * torch.linspace(0, 1, 400, dtype=nodes.dtype)
    per_log = torch.sinc((z[:, None] - nodes) / spacing) @ mass / spacing
    return z.exp().numpy(), (per_log.clamp_min(0.0) / z.exp()).numpy()


def joint_cloud(ax: Axes, clouds: Mapping[str, FloatArray], *, truth: tuple[float, float] | None = None) -> Axes:
    """Draws of T_L and K_L (draw, 2) by method, ``"exact"``, ``"SGLD"`` or ``"NUTS"``, those that are finite."""
    clouds = {method: draws[np.isfinite(draws).all(-1)] for method, draws in clouds.items()}
    for method, draws in clouds.items():
        colour = _COLOURS[method]
        ax.plot(*evenly(draws, SHOWN).T, ".", color=colour, markersize=2.5, alpha=0.4, rasterized=True)
        ax.plot([], [], ".", color=colour, markersize=8, label=method)
    if truth is not None:
        look: Any = {"color": BLACK, "markersize": 9, "markeredgecolor": "white", "linestyle": "none", "zorder": 6}
        ax.plot(*truth, "P", label="truth", **look)
    both = np.concatenate([*clouds.values(), *([] if truth is None else [np.array([truth])])])
    for k, limit in ((0, ax.set_xlim), (1, ax.set_ylim)) if len(both) else ():
        low, high = np.quantile(both[:, k], [0.001, 0.999])
        ends = [low, high] if truth is None else [min(low, truth[k]), max(high, truth[k])]
        pad = 0.06 * (ends[1] - ends[0] or 1.0)
        limit(ends[0] - pad, ends[1] + pad)
    ax.xaxis.set_major_locator(MaxNLocator(5))
    ax.set(xlabel=LABELS["T_L"], ylabel=LABELS["K_L"])
    return ax


def agreement_scatter(
    ax: Axes,
    width: FloatArray,
    value: FloatArray,
    *,
    limits: tuple[float, float],
    error: FloatArray,
    converged: np.ndarray,
    reach: float,
) -> Axes:
    """Distance of each window's posterior from the exact one over the latter's width, with the required limits.

    The share of windows inside the limits is written as the title; windows beyond the axis are triangles on its edge.

    Args:
        width: exact posterior SD as a share of the exact mean, ``(window,)``: small where excitation is strong.
        value: a difference or a ratio, ``(window,)``; where it is not finite the window counts as outside.
        limits: between which it should be.
        error: Monte Carlo standard error of ``value``, ``(window,)``; twice its median is drawn as a bar at the left.
        converged: windows whose chains and reference both converged, ``(window,)``; the others are hollow.
        reach: half height of the axis.
    """
    x, y = 100 * width, value
    middle = 0.5 * (limits[0] + limits[1])
    ax.axhspan(*limits, color=EXACT_FILL, alpha=0.5, linewidth=0, zorder=0.5, label="required limits")
    ax.axhline(middle, color=EXACT, linewidth=0.9, zorder=0.6)
    for limit in limits:
        ax.axhline(limit, color=EXACT, linewidth=0.9, linestyle="--", zorder=0.6)
    within = (y >= limits[0]) & (y <= limits[1])
    beyond = ~(np.abs(y - middle) <= reach)
    # NaN is drawn at the top
    edge = np.where(y < middle, middle - 0.95 * reach, middle + 0.95 * reach)
    at = np.where(beyond, edge, y)
    kinds = [
        (within, "o", BLUE, "window within", 4.0),
        (~within & ~beyond, "D", VERMILLION, "window outside (▲▼: off the axis)", 4.5),
        (beyond & (y < middle), "v", VERMILLION, None, 6.5),
        (beyond & ~(y < middle), "^", VERMILLION, None, 6.5),
    ]
    for mask, marker, colour, label, size in kinds:
        for good in (True, False):
            chosen = mask & (converged == good)
            if chosen.any() or (good and label):
                look: Any = {"alpha": 0.6, "markeredgewidth": 0} if good else {"fillstyle": "none"}
                text = label if good else "not converged"
                ax.plot(x[chosen], at[chosen], marker, color=colour, markersize=size, label=text, **look)
    spread = float(np.nanmedian(error))
    look = {"color": BLACK, "linewidth": 1.3, "zorder": 4, "label": "±2 Monte Carlo errors of a window"}
    bar = [middle - 2 * spread, middle + 2 * spread]
    ax.plot([0.03, 0.03], bar, "_-", transform=ax.get_yaxis_transform(), **look)
    ax.set_title(f"{100 * within.mean():.0f} % within", loc="left")
    _percent_axis(ax, x)
    ax.set_ylim(middle - reach, middle + reach)
    return ax


def agreement_reach(value: FloatArray, limits: tuple[float, float]) -> float:
    """Half height of an axis that shows nearly all values that should be within limits: 2.2 to 12 times the distance to
    a limit."""
    middle, half = 0.5 * (limits[0] + limits[1]), 0.5 * (limits[1] - limits[0])
    away = np.abs(value - middle)
    away = away[np.isfinite(away)]
    return float(np.clip(1.1 * np.quantile(away, 0.98) if len(away) else 0.0, 2.2 * half, 12 * half))


def _percent_axis(ax: Axes, x: np.ndarray) -> None:
    """Room for the bar at the left, a logarithmic axis only where decades are spanned, plain numbers as labels."""
    found = x[np.isfinite(x) & (x > 0)]
    low, high = (float(found.min()), float(found.max())) if len(found) else (1.0, 1.0)
    if high > 5 * low:
        span = np.log(high / low)
        ax.set_xscale("log")
        ax.set_xlim(low * np.exp(-0.12 * span), high * np.exp(0.06 * span))
        ax.xaxis.set_major_formatter(FuncFormatter(lambda v, _: f"{v:g}"))
        ax.xaxis.set_minor_formatter(NullFormatter())
    else:
        span = high - low or 0.1 * high
        ax.set_xlim(low - 0.12 * span, high + 0.06 * span)
        ax.xaxis.set_major_locator(MaxNLocator(5))


def _edges(values: np.ndarray, width: float) -> np.ndarray:
    """Edges of bins of about that width; what lies far from nearly all the values shares one wide bin a side."""
    low, high = np.quantile(values, [0.05, 0.95])
    reach = 3 * (high - low)
    core = max(float(values.min()), low - reach), min(float(values.max()), high + reach)
    count = int(np.clip(np.ceil((core[1] - core[0]) / width), 1, BINS)) if width > 0 else 1
    edges = np.linspace(core[0], core[1] if core[1] > core[0] else core[0] + (width or 1.0), count + 1)
    return np.unique(np.concatenate([[values.min()], edges, [values.max()]]))


# pictures of a validation -------------------------------------------------------------------------------------------
#: Exact draws a window.
EXACT_DRAWS = 4000
#: Draws whose exact probabilities are shown, at most.
MOST = 1000


@dataclass(frozen=True)
class ChosenWindow:
    """A window drawn individually: its number, its place among those NUTS was run on, what it represents."""

    number: int
    nuts: int | None
    title: str


class ChosenWindows:
    """The windows drawn individually: with the widest, a median and the narrowest posterior of the lag.

    They are of those NUTS was run on, if there are any, and converged, if any did.
    """

    def __init__(self, validation: Validation) -> None:
        self.validation = validation
        index = validation.nuts_index if len(validation.nuts_index) else validation.compared
        sound = converged(validation, index)
        index = index[sound] if bool(sound.any()) else index
        width = relative_width(validation, index)[:, 0]
        order = width.argsort(descending=True)
        places = sorted({0, len(order) // 2, len(order) - 1})
        words = {1: [""], 2: ["wide: ", "narrow: "], 3: ["wide: ", "middle: ", "narrow: "]}[len(places)]
        self.windows = [
            ChosenWindow(
                number := int(index[order[p]]),
                place(validation.nuts_index, number),
                f"{word}window {number}, SD of $T_L$ {100 * float(width[order[p]]):.2g} %",
            )
            for word, p in zip(words, places, strict=True)
        ]

    @cached_property
    def exact(self) -> Posterior | None:
        """Independent draws of the joint posterior of the selected windows, in their order."""
        index = torch.tensor([w.number for w in self.windows])
        return self.validation.quadrature_draws(index, chains=1, draws=EXACT_DRAWS)

    def draws(self, row: int) -> dict[str, Tensor]:
        """Draws of a window by method, those that there are, each (draw, parameter)."""
        found, window = self.validation, self.windows[row]
        drawn = {} if self.exact is None else {"exact": self.exact.flat[:, row]}
        drawn["SGLD"] = found.sgld.flat[:, window.number]
        return drawn if window.nuts is None else {**drawn, "NUTS": found.nuts.flat[:, window.nuts]}

    def exact_probabilities(self, row: int, i: int) -> dict[str, FloatArray]:
        """Of draws of the `i`-th parameter that are effective, the exact probability of what is below, by method."""
        found, window = self.validation, self.windows[row]
        exact, draws = found.quadrature, self.draws(row)
        assert exact is not None
        one = Quadrature(exact.names, *(getattr(exact, f.name)[[window.number]] for f in fields(exact)[1:]))
        effective = {"SGLD": found.agreement.ess_bulk[place(found.compared, window.number), i]}
        if window.nuts is not None:
            effective["NUTS"] = self._of_nuts[window.nuts, i]
        out = {}
        for method, count in effective.items():
            some = torch.from_numpy(evenly(draws[method].numpy(), _count(float(count), draws[method])))
            out[method] = one.cdf(some[:, None])[:, 0, i].clamp(0, 1).numpy()
        return out

    @cached_property
    def _of_nuts(self) -> Tensor:
        return sampling_diagnostics(self.validation.nuts).ess_bulk

    def truth(self, window: ChosenWindow, name: str) -> float | None:
        known = self.validation.windows.truth
        return None if known is None else float(known[window.number, self.validation.names.index(name)])


def evenly(values: FloatArray, most: int) -> FloatArray:
    """At most so many of the rows, evenly taken."""
    return values[np.linspace(0, len(values) - 1, min(most, len(values))).astype(int)]


def converged(validation: Validation, index: Tensor) -> Tensor:
    """Windows whose chains and quadrature converged, ``(index,)`` bool."""
    own = validation.sgld.converged[index]
    return own if validation.quadrature is None else own & validation.quadrature.converged[index]


def relative_width(validation: Validation, index: Tensor) -> Tensor:
    """SD over mean by quadrature, or by SGLD where there is none, ``(index, parameter)``."""
    known = validation.sgld if validation.quadrature is None else validation.quadrature
    return known.sd[index] / known.mean[index]


def _count(effective: float, draws: Tensor) -> int:
    """An effective sample size as a number of draws: chains that stand still have none."""
    return max(4, min(round(effective), len(draws.flatten()), MOST)) if math.isfinite(effective) else 4


def place(index: Tensor, window: int) -> int | None:
    """Where a window is in a list of windows."""
    found = (index == window).nonzero()
    return int(found[0]) if len(found) else None


METHOD = {"nuts": "NUTS", "quadrature": "quadrature"}


def validation_figures(validation: Validation) -> dict[str, Callable[[], Figure]]:
    """The figures of a validation, by the name of the file that each is for; a figure is made when called.

    Example:
        >>> from avtorch.inference import SamplerSettings
        >>> from avtorch.plots import validation_figures
        >>> from avtorch.validation import NutsSettings, synthetic_windows, validate
        >>> quick = dict(settings=SamplerSettings(chains=64), nuts=NutsSettings(1, 20, 10), nuts_windows=1)
        >>> figures = validation_figures(validate(synthetic_windows(1, seed=1), **quick))
        >>> sorted(figures)
        ['agreement.png', 'ecdf.png', 'joint.png', 'marginals.png']
    """
    chosen = ChosenWindows(validation)
    figures: dict[str, Callable[[], Figure]] = {
        "marginals.png": lambda: marginals_figure(chosen),
        "joint.png": lambda: joint_figure(chosen),
        "agreement.png": lambda: agreement_figure(validation),
    }
    if validation.quadrature is not None:
        figures["ecdf.png"] = lambda: ecdf_figure(chosen)
    return figures


@styled
def marginals_figure(chosen: ChosenWindows) -> Figure:
    """Exact marginals with the histograms of SGLD and NUTS; a row a window, a column a parameter."""
    found, names = chosen.validation, chosen.validation.names
    figure, axes = _panels(len(chosen.windows), len(names), (_wide(names), 2.3))
    for row, (window, line) in enumerate(zip(chosen.windows, axes, strict=True)):
        for name, ax in zip(names, line, strict=True):
            other = None if window.nuts is None else found.nuts[name][..., window.nuts].numpy()
            own = found.sgld[name][..., window.number].numpy()
            marginals(ax, name, own, other, found.quadrature, window.number, truth=chosen.truth(window, name))
            if row < len(axes) - 1:
                ax.set_xlabel("")
        line[0].set_title(window.title)
        line[0].set_ylabel("density")
    _legend(figure, axes)
    return figure


@styled
def joint_figure(chosen: ChosenWindows) -> Figure:
    """Clouds of lag and gain by SGLD, by NUTS and exact; a panel a window."""
    found = chosen.validation
    figure, axes = _panels(1, len(chosen.windows), (3.9, 3.7))
    pair = [found.names.index(name) for name in ("T_L", "K_L")]
    for i, (window, ax) in enumerate(zip(chosen.windows, axes[0], strict=True)):
        lag, gain = chosen.truth(window, "T_L"), chosen.truth(window, "K_L")
        truth = None if lag is None or gain is None else (lag, gain)
        joint_cloud(ax, {method: draws[:, pair].numpy() for method, draws in chosen.draws(i).items()}, truth=truth)
        ax.set_title(window.title)
        if i:
            ax.set_ylabel("")
    _legend(figure, axes)
    return figure


@styled
def ecdf_figure(chosen: ChosenWindows) -> Figure:
    """Exact probabilities below the draws: their ECDF less the uniform one and its 95 % band, by ArviZ; a row a window.

    Draws count by their effective sample size.
    """
    names = chosen.validation.names
    figure, axes = _panels(len(chosen.windows), len(names), (_wide(names), 2.4), beside=0.5)
    for row, (window, line) in enumerate(zip(chosen.windows, axes, strict=True)):
        for i, (name, ax) in enumerate(zip(names, line, strict=True)):
            for method, values in chosen.exact_probabilities(row, i).items():
                look = {"color": _COLOURS[method]}
                arviz().plot_ecdf(
                    values,
                    cdf=uniform.cdf,
                    rvs=uniform().rvs,
                    eval_points=np.linspace(0.01, 0.99, 99),
                    difference=True,
                    confidence_bands="simulated",
                    random_state=0,
                    ci_prob=0.95,
                    plot_kwargs={**look, "label": method},
                    fill_kwargs={**look, "alpha": 0.15},
                    ax=ax,
                )
            ax.set(xlabel=f"exact probability below a draw of {short(name)}", ylabel="" if i else "ECDF less uniform")
        line[0].set_title(window.title)
    _legend(figure, axes)
    return figure


@styled
def agreement_figure(validation: Validation) -> Figure:
    """Differences of mean and ratios of SD of every window over the width of its posterior, with the limits."""
    names, found, index = validation.names, validation.agreement, validation.compared
    width, sound = relative_width(validation, index), converged(validation, index)
    figure, axes = _panels(2, len(names), (_wide(names), 2.75), beside=0.4, sharey="row")
    measures = [
        ("difference of means [posterior SD]", found.mean_difference, found.mean_error, 0.0, MEAN_TOLERANCE),
        ("ratio of SDs [-]", found.sd_ratio, found.sd_error, 1.0, SD_TOLERANCE),
    ]
    for line, (label, value, error, middle, tolerance) in zip(axes, measures, strict=True):
        limits = (middle - tolerance, middle + tolerance)
        reach = max(agreement_reach(value[:, i].numpy(), limits) for i in range(len(names)))
        for i, (name, ax) in enumerate(zip(names, line, strict=True)):
            agreement_scatter(
                ax,
                width[:, i].numpy(),
                value[:, i].numpy(),
                limits=limits,
                error=error[:, i].numpy(),
                converged=sound.numpy(),
                reach=reach,
            )
            ax.set_title(f"{short(name)}: {ax.get_title('left')}")
            ax.set_xlabel(f"SD of {short(name)} [% of its mean]" if len(names) <= 3 else "SD [% of mean]")
        line[0].set_ylabel(label)
    v = validation.verdict
    _title(
        figure,
        f"SGLD against {METHOD[validation.reference]}: {100 * v.share:.1f} % of {len(index)} windows within all limits"
        f" (95 % interval {100 * v.low:.1f} to {100 * v.high:.1f} %;"
        f" exact draws would be at {100 * v.share_if_exact:.1f} %)",
    )
    _legend(figure, axes, where="lower center")
    return figure


def _wide(names: tuple[str, ...]) -> float:
    """Width of a panel [inch]: many parameters share the paper."""
    return 3.0 if len(names) <= 3 else 2.6


def _panels(
    rows: int, columns: int, panel: tuple[float, float], *, beside: float = 0.3, sharey: Literal["row"] | bool = False
) -> tuple[Figure, np.ndarray]:
    """A figure and its axes (row, column), each of a `panel`'s width and height [in]."""
    wide, high = panel
    figure = Figure(figsize=(wide * columns + beside, high * rows + 0.9), layout="constrained")
    return figure, figure.subplots(rows, columns, squeeze=False, sharey=sharey)


def _title(figure: Figure, text: str) -> None:
    """Above all panels, in lines as long as these are wide."""
    letters = round(11.0 * figure.get_figwidth())
    figure.suptitle("\n".join(textwrap.wrap(text, letters)), fontsize=9.5, color=BLACK)


def _legend(figure: Figure, axes: np.ndarray, *, where: str = "upper center") -> None:
    """One legend for all axes, above or below them: in as many columns as there is room for."""
    longest = max((len(label) for ax in axes.flat for label in ax.get_legend_handles_labels()[1]), default=0)
    column = 0.5 + 0.085 * longest  # inches, in the size of a legend's letters
    columns = max(1, min(6, int(figure.get_figwidth() / column)))
    legend(figure, axes.flat, where=where, columns=columns)
