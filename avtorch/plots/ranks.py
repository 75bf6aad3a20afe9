"""Drawings of ranks: is one set of draws spread over another as it should be? Each takes an axes and returns it.

The bands hold all of their bars, or the whole curve, at once with the probability written: a picture is off if anything
in it leaves the band. Correlated draws count by their effective sample size.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import ArrayLike

from avtorch.arrays import FloatArray, IntArray
from avtorch.errors import InputError
from avtorch.plots.style import BLACK, BLUE, GREEN, GREY, PURPLE, VERMILLION

BAND = "#D5D5D5"
METHODS = {"SGLD": BLUE, "NUTS": VERMILLION, "exact": "#555555"}
LOOKS = [
    {"color": BLUE, "linestyle": "-"},
    {"color": VERMILLION, "linestyle": "--"},
    {"color": GREEN, "linestyle": "-."},
    {"color": PURPLE, "linestyle": (0, (1, 1))},
    {"color": BLACK, "linestyle": (0, (5, 1, 1, 1, 1, 1))},
]


def pooled_rank_counts(groups: Mapping[str, ArrayLike], *, bins: int = 20) -> dict[str, IntArray]:
    """Rank all draws among each other and count, per group, how many ranks fall into each of ``bins`` equal bins.

    Groups that follow one law have the same, uniform counts (Vehtari et al. 2021, section 4.3).

    Raises:
        InputError: for fewer than two groups, or an empty one.
    """
    arrays = {name: np.asarray(values, dtype=float).ravel() for name, values in groups.items()}
    if len(arrays) < 2 or not all(len(a) for a in arrays.values()):
        raise InputError(f"groups: found sizes {[len(a) for a in arrays.values()]}, need two or more that hold draws")
    pool = np.concatenate(list(arrays.values()))
    rank = np.empty(len(pool), dtype=np.int64)
    rank[np.argsort(pool, kind="stable")] = np.arange(len(pool))
    binned = np.split(rank * bins // len(pool), np.cumsum([len(a) for a in arrays.values()])[:-1])
    return {name: np.bincount(b, minlength=bins) for name, b in zip(arrays, binned, strict=True)}


def rank_band(
    counts: Mapping[str, ArrayLike], *, effective: Mapping[str, float] | None = None, level: float = 0.95
) -> dict[str, tuple[float, float]]:
    """Least and greatest height, relative to the one expected, that hold all bars of all groups with prob. ``level``.

    One group alone: ranks of truths, binomial. Several: ranks in the pool that the group is part of, binomial with as
    many draws as have the group's variance about the pool. Bonferroni over the bars, so the band is a little wide.

    Args:
        counts: ``(bin,)`` a group.
        effective: effective sample size of a group of correlated draws; its count where it is not given.
    """
    # imported here, because scipy.stats takes as long as matplotlib and few figures need it
    from scipy.stats import binom

    size = {name: float(np.sum(c)) for name, c in counts.items()}
    worth = {name: max(1.0, (effective or {}).get(name, n)) for name, n in size.items()}
    pool, bins = sum(size.values()), len(np.asarray(next(iter(counts.values()))))
    miss = (1 - level) / (2 * len(counts) * bins)
    band = {}
    for name in counts:
        # variance of F_group - F_pool, over p(1 - p)
        own = (1 - size[name] / pool) ** 2 / worth[name]
        rest = sum((size[other] / pool) ** 2 / worth[other] for other in counts if other != name)
        draws = int(worth[name] if len(counts) == 1 else 1 / (own + rest))
        low, high = binom.ppf([miss, 1 - miss], draws, 1 / bins)
        band[name] = (float(low * bins / draws - 1), float(high * bins / draws - 1))
    return band


def rank_plot(
    ax: Axes, counts: Mapping[str, ArrayLike], *, effective: Mapping[str, float] | None = None, level: float = 0.95
) -> Axes:
    """Rank histograms, one row a group, each with the band of uniform ranks.

    Bars are relative to the count expected. Each row has its own scale: its band, whose half width is written beside
    it. Bars that leave it are crossed.

    Args:
        counts: ``(bin,)``, of ranks in equal bins, by the name of the group (:func:`pooled_rank_counts`, or SBC's).
        effective, level: see :func:`rank_band`.
    """
    edges = np.linspace(0, 1, len(np.asarray(next(iter(counts.values())))) + 1)
    centres = 0.5 * (edges[1:] + edges[:-1])
    bands = rank_band(counts, effective=effective, level=level)
    for row, (name, count) in enumerate(counts.items()):
        relative = np.asarray(count, dtype=float) * len(centres) / np.sum(count) - 1
        low, high = bands[name]
        scale = 0.46 / max(1.25 * high, -1.25 * low, float(np.abs(relative).max()))
        ax.fill_between([0, 1], scale * low - row, scale * high - row, color=BAND, linewidth=0, zorder=1)
        colour = next((c for method, c in METHODS.items() if name.startswith(method)), BLUE)
        ax.stairs(scale * relative - row, edges, baseline=-row, fill=True, color=colour, alpha=0.8, zorder=2)
        ax.plot([0, 1], [-row, -row], color=GREY, linewidth=0.8, zorder=2.5)
        out = (relative < low) | (relative > high)
        ax.plot(centres[out], scale * relative[out] - row, "x", color=BLACK, markersize=5, zorder=3)
        ax.text(1.01, -row, f"±{50 * (high - low):.0f} %", transform=ax.get_yaxis_transform(), va="center", fontsize=8,
                color=GREY)  # fmt: skip
    ax.set_xlim(0, 1)
    ax.set_ylim(0.5 - len(counts), 0.5)
    ax.set_yticks([-r for r in range(len(counts))], list(counts))
    ax.tick_params(axis="y", length=0)
    ax.grid(False)
    return ax


def ecdf_difference(
    ax: Axes,
    ecdf: Mapping[str, ArrayLike],
    band: tuple[ArrayLike, ArrayLike],
    *,
    label: str | None = "95 % band of uniform",
) -> Axes:
    """ECDF of ranks or PIT values less that of the uniform law, in its simultaneous band (Sailynoja et al. 2022).

    Args:
        ecdf: share of ranks at or below ``0..draws``, ``(draws + 1,)``, by name (`RankCalibration.ecdf`, or
            :func:`ecdf_of`).
        band: lower and upper bound of such an ECDF, ``(draws + 1,)`` each (`validation.uniformity.ecdf_band`).
        label: what the band is, for the legend.
    """
    low, high = (np.asarray(side, dtype=float) for side in band)
    x = np.arange(1, len(low) + 1) / len(low)
    at = np.concatenate([[0.0], x])
    edges = [np.concatenate([[0.0], side - x]) for side in (low, high)]
    ax.fill_between(at, edges[0], edges[1], color=BAND, linewidth=0, label=label, zorder=1)
    ax.axhline(0.0, color=GREY, linewidth=0.8, zorder=1.5)
    for (name, share), look in zip(ecdf.items(), _looks(len(ecdf)), strict=True):
        ax.plot(at, np.concatenate([[0.0], np.asarray(share, dtype=float) - x]), label=name, zorder=2, **look)
    low_y, high_y = ax.get_ylim()
    reach = max(-low_y, high_y)
    ax.set_ylim(-reach, reach)
    ax.set_xlim(0, 1)
    ax.set_ylabel("ECDF less uniform [-]")
    return ax


def ecdf_of(values: ArrayLike, points: int = 100) -> FloatArray:
    """Share of ``values`` in [0, 1] (PIT values) below ``1/points, 2/points, ..., 1``."""
    found = np.asarray(values, dtype=float).ravel()
    binned = np.clip((found * points).astype(np.int64), 0, points - 1)
    return np.bincount(binned, minlength=points).cumsum() / len(found)


def _looks(count: int) -> Sequence[dict]:
    """A line style per curve, distinct in dashes as well as in colour."""
    return [LOOKS[i % len(LOOKS)] for i in range(count)]
