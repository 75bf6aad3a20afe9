"""The pictures of a validation: SGLD compared with quadrature and NUTS, for some windows and for all together."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Callable
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Literal

import numpy as np
import torch
from matplotlib.figure import Figure
from scipy.stats import uniform
from torch import Tensor

from avtorch.arrays import FloatArray
from avtorch.inference import Posterior, Quadrature
from avtorch.inference.arviz_export import arviz
from avtorch.plots.posteriors import agreement_reach, agreement_scatter, joint_cloud, marginals
from avtorch.plots.style import BLACK, BLUE, VERMILLION, short, styled
from avtorch.validation.agreement import MEAN_TOLERANCE, SD_TOLERANCE, sampling_diagnostics
from avtorch.validation.validate import Validation

#: Exact draws a window, for contours and ranks.
EXACT = 4000
#: Groups that SGLD's chains are joined into for their ranks, and draws of a group at most.
GROUPS, MOST = 4, 1000


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
        return self.validation.quadrature_draws(index, chains=1, draws=EXACT)

    def groups(self, row: int, i: int) -> dict[str, FloatArray]:
        """Draws of the `i`-th parameter by group, as many as are effective: SGLD's chains in four, NUTS, exact."""
        found, window = self.validation, self.windows[row]
        parts = found.sgld.draws[:, :, window.number, i].tensor_split(min(GROUPS, found.sgld.draws.shape[0]))
        worth = self._effective(row, i, "SGLD") / len(parts)
        named = {f"SGLD {k + 1}": evenly(x.flatten().numpy(), _count(worth, x)) for k, x in enumerate(parts)}
        if window.nuts is not None:
            drawn = found.nuts.flat[:, window.nuts, i]
            named["NUTS"] = evenly(drawn.numpy(), _count(self._effective(row, i, "NUTS"), drawn))
        return named if self.exact is None else {**named, "exact": self.exact.flat[:, row, i].numpy()}

    def exact_probabilities(self, row: int, i: int) -> dict[str, FloatArray]:
        """Of draws of the `i`-th parameter that are effective, the exact probability of what is below, by method."""
        found, window = self.validation, self.windows[row]
        exact = found.quadrature
        assert exact is not None
        drawn = {"SGLD": found.sgld.flat[:, window.number]}
        if window.nuts is not None:
            drawn["NUTS"] = found.nuts.flat[:, window.nuts]
        out = {}
        for method, draws in drawn.items():
            some = torch.from_numpy(evenly(draws.numpy(), _count(self._effective(row, i, method), draws)))
            one = Quadrature(exact.names, *(getattr(exact, f.name)[[window.number]] for f in fields(exact)[1:]))
            out[method] = one.cdf(some[:, None])[:, 0, i].clamp(0, 1).numpy()
        return out

    @cached_property
    def _of_nuts(self) -> Tensor:
        return sampling_diagnostics(self.validation.nuts).ess_bulk

    def _effective(self, row: int, i: int, method: str) -> float:
        found, window = self.validation, self.windows[row]
        if method == "SGLD":
            return float(found.agreement.ess_bulk[place(found.compared, window.number), i])
        return float(self._of_nuts[window.nuts, i])

    def truth(self, window: ChosenWindow, name: str) -> float | None:
        known = self.validation.windows.truth
        return None if known is None else float(known[window.number, self.validation.names.index(name)])


def evenly(values: FloatArray, count: int) -> FloatArray:
    """`count` of the values, evenly taken."""
    return values[np.linspace(0, len(values) - 1, count).astype(int)]


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


_NARROW = 4.0  # inches
_COLOURS = {"SGLD": BLUE, "NUTS": VERMILLION, "exact": "#555555"}
BINS = 10
"""Of ranks."""

METHOD = {"nuts": "NUTS", "quadrature": "quadrature"}
Place = Literal["outside upper center", "outside lower center"]


VALIDATION_PICTURES = ("marginals.png", "joint.png", "ranks.png", "agreement.png", "ecdf.png")
"""Every file that `validation_figures` may name."""


def validation_figures(validation: Validation, *, narrow: bool = False) -> dict[str, Callable[[], Figure]]:
    """The figures of a validation, by the name of the file that each is for; a figure is made when called.

    `narrow`: for a phone, panels one above the other.

    Example:
        >>> from avtorch.inference import SamplerSettings
        >>> from avtorch.plots import validation_figures
        >>> from avtorch.validation import NutsSettings, synthetic_windows, validate
        >>> quick = dict(settings=SamplerSettings(chains=64), nuts=NutsSettings(1, 20, 10), nuts_windows=1)
        >>> figures = validation_figures(validate(synthetic_windows(1, seed=1), **quick))
        >>> sorted(figures)
        ['agreement.png', 'ecdf.png', 'joint.png', 'marginals.png', 'ranks.png']
    """
    chosen = ChosenWindows(validation)
    figures: dict[str, Callable[[], Figure]] = {
        "marginals.png": lambda: marginals_figure(chosen, narrow=narrow),
        "joint.png": lambda: joint_figure(chosen, narrow=narrow),
        "ranks.png": lambda: ranks_figure(chosen, narrow=narrow),
        "agreement.png": lambda: agreement_figure(validation, narrow=narrow),
    }
    if validation.quadrature is not None:
        figures["ecdf.png"] = lambda: ecdf_figure(chosen, narrow=narrow)
    return figures


@styled
def marginals_figure(chosen: ChosenWindows, *, narrow: bool = False) -> Figure:
    """Exact marginals with the histograms of SGLD and NUTS; a row a window, a column a parameter."""
    found, names = chosen.validation, chosen.validation.names
    figure, axes = _panels(len(chosen.windows), len(names), (_wide(names), 2.3), narrow=narrow)
    for row, (window, line) in enumerate(zip(chosen.windows, axes, strict=True)):
        for name, ax in zip(names, line, strict=True):
            other = None if window.nuts is None else found.nuts[name][..., window.nuts].numpy()
            own = found.sgld[name][..., window.number].numpy()
            marginals(ax, name, own, other, found.quadrature, window.number, truth=chosen.truth(window, name))
            if row < len(axes) - 1 and not narrow:
                ax.set_xlabel("")
        line[0].set_title(window.title)
        line[0].set_ylabel("density")
    _legend(figure, axes, narrow=narrow)
    return figure


@styled
def joint_figure(chosen: ChosenWindows, *, narrow: bool = False) -> Figure:
    """Clouds of lag and gain within the 50 and 90 % regions of exact draws and of NUTS; a panel a window."""
    found = chosen.validation
    figure, axes = _panels(1, len(chosen.windows), (3.9, 3.7), narrow=narrow)
    for i, (window, ax) in enumerate(zip(chosen.windows, axes[0], strict=True)):
        references = {} if chosen.exact is None else {"exact": (chosen.exact, i)}
        if window.nuts is not None:
            references["NUTS"] = (found.nuts, window.nuts)
        lag, gain = chosen.truth(window, "T_L"), chosen.truth(window, "K_L")
        truth = None if lag is None or gain is None else (lag, gain)
        joint_cloud(ax, found.sgld, window.number, references=references, truth=truth)
        ax.set_title("\n".join(t for t in (window.title, ax.get_title("left")) if t))
        if i and not narrow:
            ax.set_ylabel("")
    _legend(figure, axes, narrow=narrow)
    return figure


@styled
def ranks_figure(chosen: ChosenWindows, *, narrow: bool = False) -> Figure:
    """Ranks of groups of SGLD's chains, of NUTS and of exact draws in their common pool, by ArviZ; a row a window."""
    names = chosen.validation.names
    rows = len(chosen.groups(0, 0))
    size = (_wide(names), 0.33 * rows + 0.6)
    figure, axes = _panels(len(chosen.windows), len(names), size, beside=0.9, narrow=narrow)
    for row, (window, line) in enumerate(zip(chosen.windows, axes, strict=True)):
        for i, (name, ax) in enumerate(zip(names, line, strict=True)):
            groups = chosen.groups(row, i)
            least = min(map(len, groups.values()))
            pool = np.stack([evenly(x, least) for x in groups.values()])
            arviz().plot_rank({name: pool}, bins=BINS, ax=ax, colors=[_COLOURS[group.split()[0]] for group in groups])
            ax.set(title="", ylabel="", xlabel=f"rank of {short(name)}" if row == len(axes) - 1 or narrow else "")
            ax.xaxis.label.set_size("medium")
            ax.set_yticklabels(list(groups) if narrow or not i else [])
        line[0].set_title(window.title)
    _title(figure, "Ranks of each group in the pool of all draws, as many as are effective: even bars agree", narrow)
    return figure


@styled
def ecdf_figure(chosen: ChosenWindows, *, narrow: bool = False) -> Figure:
    """Exact probabilities below the draws: their ECDF less the uniform one and its 95 % band, by ArviZ; a row a window.

    Draws count by their effective sample size.
    """
    names = chosen.validation.names
    figure, axes = _panels(len(chosen.windows), len(names), (_wide(names), 2.4), beside=0.5, narrow=narrow)
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
    _legend(figure, axes, narrow=narrow)
    return figure


@styled
def agreement_figure(validation: Validation, *, narrow: bool = False) -> Figure:
    """Differences of mean and ratios of SD of every window over the width of its posterior, with the limits."""
    names, found, index = validation.names, validation.agreement, validation.compared
    width, sound = relative_width(validation, index), converged(validation, index)
    figure, axes = _panels(2, len(names), (_wide(names), 2.75), beside=0.4, sharey="row", narrow=narrow)
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
        narrow,
    )
    _legend(figure, axes, where="outside lower center", narrow=narrow)
    return figure


def _wide(names: tuple[str, ...]) -> float:
    """Width of a panel [inch]: many parameters share the paper."""
    return 3.0 if len(names) <= 3 else 2.6


def _panels(
    rows: int,
    columns: int,
    panel: tuple[float, float],
    *,
    beside: float = 0.3,
    sharey: Literal["row"] | bool = False,
    narrow: bool = False,
) -> tuple[Figure, np.ndarray]:
    """A figure and its axes (row, column), each of a `panel`'s width and height [in]; `narrow`: all in one column."""
    wide, high = panel
    if narrow:
        figure = Figure(figsize=(_NARROW, high * rows * columns + 1.4), layout="constrained")
        return figure, figure.subplots(rows * columns, 1, squeeze=False).reshape(rows, columns)
    figure = Figure(figsize=(wide * columns + beside, high * rows + 0.9), layout="constrained")
    return figure, figure.subplots(rows, columns, squeeze=False, sharey=sharey)


def _title(figure: Figure, text: str, narrow: bool) -> None:
    """Above all panels, in lines as long as these are wide."""
    letters = round((9.0 if narrow else 11.0) * figure.get_figwidth())
    figure.suptitle("\n".join(textwrap.wrap(text, letters)), fontsize=9.5, color=BLACK)


def _legend(
    figure: Figure,
    axes: np.ndarray,
    *,
    where: Literal["outside upper center", "outside lower center"] = "outside upper center",
    narrow: bool = False,
) -> None:
    """One legend for all axes, each name once, above or below them."""
    found: dict = {}
    for ax in axes.flat:
        for handle, label in zip(*ax.get_legend_handles_labels(), strict=True):
            found.setdefault(label, handle)
    column = 0.5 + 0.085 * max(map(len, found), default=0)  # inches, in the size of a legend's letters
    columns = 1 if narrow else max(1, min(len(found), 6, int(figure.get_figwidth() / column)))
    figure.legend(list(found.values()), list(found), loc=where, ncols=columns)
