"""Drawings of posteriors and their references. Each takes an axes and returns it.

Each method has one style everywhere: grey and filled is exact (quadrature), blue is avtorch's SGLD, vermillion and
dashed NUTS, black the truth.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.ticker import FuncFormatter, MaxNLocator, NullFormatter
from numpy.typing import ArrayLike

from avtorch.inference import Posterior, Quadrature
from avtorch.plots.style import BLACK, BLUE, LABELS, VERMILLION

if TYPE_CHECKING:
    from scipy.stats import gaussian_kde

EXACT, EXACT_FILL = "#555555", "#DADADA"
#: Draws from which the contours of a reference are smoothed, and nodes an axis on which they are followed.
KERNELS, MESH = 4000, 90
CONTOURS: dict[str, Any] = {
    "exact": {"color": BLACK, "linestyle": "-", "linewidth": 1.4},
    "NUTS": {"color": VERMILLION, "linestyle": "--", "linewidth": 1.4},
}
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
        ax.fill_between(value, density, facecolor=EXACT_FILL, edgecolor=EXACT, linewidth=1.0,
                        label="exact (quadrature)", zorder=1.5)  # fmt: skip
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


def exact_density(
    quadrature: Quadrature, name: str, window: int = 0, *, points: int = 400, tail: float = 5e-4
) -> tuple[np.ndarray, np.ndarray]:
    """A marginal as a smooth curve: values in the parameter's unit and the density there, per that unit.

    The nodes' masses are band-limited, so their sinc interpolant is as exact as the grid (as in `Quadrature.cdf`).

    Args:
        tail: mass left out at either end.
    """
    i = quadrature.names.index(name)
    nodes, mass = quadrature.nodes[window, i], quadrature.mass[window, i]
    spacing = nodes[1] - nodes[0]
    ends = torch.stack([quadrature.quantile(q)[window, i] for q in (tail, 1 - tail)]).log()
    z = ends[0] + (ends[1] - ends[0]) * torch.linspace(0, 1, points, dtype=nodes.dtype)
    per_log = torch.sinc((z[:, None] - nodes) / spacing) @ mass / spacing
    return z.exp().numpy(), (per_log.clamp_min(0.0) / z.exp()).numpy()


def joint_cloud(
    ax: Axes,
    posterior: Posterior,
    window: int = 0,
    *,
    references: Mapping[str, tuple[Posterior, int]] | None = None,
    names: tuple[str, str] = ("T_L", "K_L"),
    truth: tuple[float, float] | None = None,
    shown: int = 1500,
) -> Axes:
    """Draws of two parameters as a cloud, and the smallest regions that hold 50 and 90 % of each reference's draws.

    The shares of the cloud within the regions of the first reference are written as the title; they are 50 and 90 %
    where the two agree.

    Args:
        posterior: the posterior under test, drawn as points.
        references: draws for the contours and which of their windows, by method: ``"exact"``, ``"NUTS"``.
        shown: points drawn at most, evenly taken.
    """
    cloud = _pair(posterior, names, window)
    ax.plot(*_thinned(cloud, shown).T, ".", color=BLUE, markersize=2.5, alpha=0.4, rasterized=True)
    ax.plot([], [], ".", color=BLUE, markersize=8, label="SGLD")
    spread = [cloud]
    for number, (method, (reference, own)) in enumerate((references or {}).items()):
        drawn = _thinned(_pair(reference, names, own), KERNELS)
        spread.append(drawn)
        kernel, levels = _regions(np.log(drawn))
        axes = [np.linspace(*_widened(np.log(drawn[:, k])), MESH) for k in (0, 1)]
        mesh = kernel(np.stack(np.meshgrid(*axes)).reshape(2, -1)).reshape(MESH, MESH)
        look = CONTOURS.get(method, CONTOURS["exact"])
        ax.contour(*np.exp(axes), mesh, levels=sorted(levels), zorder=3 + number,
                   colors=look["color"], linestyles=look["linestyle"], linewidths=look["linewidth"])  # fmt: skip
        ax.plot([], [], label=f"{method}, 50 and 90 % regions", **look)
        if number == 0 and len(cloud):
            at_cloud = kernel(np.log(_thinned(cloud, 2 * KERNELS)).T)
            inside = [100 * float((at_cloud >= level).mean()) for level in levels]
            ax.set_title(f"SGLD inside: {inside[0]:.0f} and {inside[1]:.0f} %", loc="left")
    if truth is not None:
        ax.plot(*truth, "P", color=BLACK, markersize=9, markeredgecolor="white", label="truth", linestyle="none",
                zorder=6)  # fmt: skip
    both = np.concatenate(spread)
    for k, limit in ((0, ax.set_xlim), (1, ax.set_ylim)) if len(both) else ():
        low, high = np.quantile(both[:, k], [0.001, 0.999])
        ends = [low, high] if truth is None else [min(low, truth[k]), max(high, truth[k])]
        pad = 0.06 * (ends[1] - ends[0] or 1.0)
        limit(ends[0] - pad, ends[1] + pad)
    ax.xaxis.set_major_locator(MaxNLocator(5))
    ax.set_xlabel(LABELS.get(names[0], names[0]))
    ax.set_ylabel(LABELS.get(names[1], names[1]))
    return ax


def agreement_scatter(
    ax: Axes,
    width: ArrayLike,
    value: ArrayLike,
    *,
    limits: tuple[float, float],
    error: ArrayLike | None = None,
    converged: ArrayLike | None = None,
    reach: float | None = None,
) -> Axes:
    """Distance of each window's posterior from the exact one over the latter's width, with the required limits.

    The share of windows inside the limits is written as the title; windows beyond the axis are triangles on its edge.

    Args:
        width: exact posterior SD as a share of the exact mean, ``(window,)``: small where excitation is strong.
        value: a difference or a ratio, ``(window,)``; where it is not finite the window counts as outside.
        limits: between which it should be.
        error: Monte Carlo standard error of ``value``, ``(window,)``; twice its median is drawn as a bar at the left.
        converged: windows whose chains and reference both converged, ``(window,)``; the others are hollow.
        reach: half height of the axis; by default it shows nearly all windows, and at least twice the limits.
    """
    x, y = 100 * np.asarray(width, dtype=float), np.asarray(value, dtype=float)
    middle = 0.5 * (limits[0] + limits[1])
    reach = agreement_reach(y, limits) if reach is None else reach
    ax.axhspan(*limits, color=EXACT_FILL, alpha=0.5, linewidth=0, zorder=0.5, label="required limits")
    ax.axhline(middle, color=EXACT, linewidth=0.9, zorder=0.6)
    for limit in limits:
        ax.axhline(limit, color=EXACT, linewidth=0.9, linestyle="--", zorder=0.6)
    within = (y >= limits[0]) & (y <= limits[1])
    beyond = ~(np.abs(y - middle) <= reach)
    sound = np.ones(len(y), bool) if converged is None else np.asarray(converged, bool)
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
            chosen = mask & (sound == good)
            if chosen.any() or (good and label):
                look: Any = {"alpha": 0.6, "markeredgewidth": 0} if good else {"fillstyle": "none"}
                text = label if good else "not converged"
                ax.plot(x[chosen], at[chosen], marker, color=colour, markersize=size, label=text, **look)
    if error is not None:
        spread = float(np.nanmedian(np.asarray(error, dtype=float)))
        ax.plot([0.03, 0.03], [middle - 2 * spread, middle + 2 * spread], "_-", color=BLACK, linewidth=1.3, zorder=4,
                transform=ax.get_yaxis_transform(), label="±2 Monte Carlo errors of a window")  # fmt: skip
    ax.set_title(f"{100 * within.mean():.0f} % within", loc="left")
    _percent_axis(ax, x)
    ax.set_ylim(middle - reach, middle + reach)
    return ax


def agreement_reach(value: ArrayLike, limits: tuple[float, float]) -> float:
    """Half height of an axis for values that should be within limits: 2.2 to 12 times the distance to a limit."""
    middle, half = 0.5 * (limits[0] + limits[1]), 0.5 * (limits[1] - limits[0])
    away = np.abs(np.asarray(value, dtype=float) - middle)
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


def _pair(posterior: Posterior, names: tuple[str, str], window: int) -> np.ndarray:
    """Finite draws of two parameters, ``(draw, 2)``."""
    columns = [posterior[name][..., window].flatten() for name in names]
    both = torch.stack(columns, -1)
    return both[both.isfinite().all(-1)].numpy()


def _regions(draws: np.ndarray) -> tuple[gaussian_kde, tuple[float, float]]:
    """A smooth density of draws ``(draw, 2)``, and its heights around 50 and 90 % of them."""
    # imported here, because scipy.stats takes as long as matplotlib and few figures need it
    from scipy.stats import gaussian_kde

    kernel = gaussian_kde(draws.T)
    # leave one out: under its own kernel a draw's density would be too high
    own = 1 / (2 * np.pi * np.sqrt(np.linalg.det(kernel.covariance)))
    others = (len(draws) * kernel(draws.T) - own) / (len(draws) - 1)
    fifty, ninety = np.quantile(others, [0.5, 0.1])
    return kernel, (float(fifty), float(ninety))


def _thinned(draws: np.ndarray, most: int) -> np.ndarray:
    """At most ``most`` rows, evenly taken."""
    return draws[np.linspace(0, len(draws) - 1, min(most, len(draws))).astype(int)]


def _widened(values: np.ndarray, share: float = 0.15) -> tuple[float, float]:
    pad = share * float(np.ptp(values))
    return float(values.min()) - pad, float(values.max()) + pad


def _edges(values: np.ndarray, width: float) -> np.ndarray:
    """Edges of bins of about that width; what lies far from nearly all the values shares one wide bin a side."""
    low, high = np.quantile(values, [0.05, 0.95])
    reach = 3 * (high - low)
    core = max(float(values.min()), low - reach), min(float(values.max()), high + reach)
    count = int(np.clip(np.ceil((core[1] - core[0]) / width), 1, BINS)) if width > 0 else 1
    edges = np.linspace(core[0], core[1] if core[1] > core[0] else core[0] + (width or 1.0), count + 1)
    return np.unique(np.concatenate([[values.min()], edges, [values.max()]]))
