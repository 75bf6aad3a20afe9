"""The windows of a validation that are drawn one by one, and their data."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from avtorch.arrays import FloatArray
from avtorch.inference import Posterior
from avtorch.validation.diagnostics import sampling_diagnostics
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
        assert found.quadrature is not None
        drawn = {"SGLD": found.sgld.flat[:, window.number]}
        if window.nuts is not None:
            drawn["NUTS"] = found.nuts.flat[:, window.nuts]
        out = {}
        for method, draws in drawn.items():
            some = torch.from_numpy(evenly(draws.numpy(), _count(self._effective(row, i, method), draws)))
            one = replace(found.quadrature, nodes=found.quadrature.nodes[[window.number]],
                          mass=found.quadrature.mass[[window.number]])  # fmt: skip
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
