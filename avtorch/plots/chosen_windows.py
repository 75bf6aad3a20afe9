"""The windows of a validation that are drawn one by one, and their data."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from avtorch.inference import Posterior
from avtorch.validation.validate import Validation

#: Exact draws a window, for contours and ranks.
EXACT = 4000


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

    def truth(self, window: ChosenWindow, name: str) -> float | None:
        known = self.validation.windows.truth
        return None if known is None else float(known[window.number, self.validation.names.index(name)])


def converged(validation: Validation, index: Tensor) -> Tensor:
    """Windows whose chains and quadrature converged, ``(index,)`` bool."""
    own = validation.sgld.converged[index]
    return own if validation.quadrature is None else own & validation.quadrature.converged[index]


def relative_width(validation: Validation, index: Tensor) -> Tensor:
    """SD over mean by quadrature, or by SGLD where there is none, ``(index, parameter)``."""
    known = validation.sgld if validation.quadrature is None else validation.quadrature
    return known.sd[index] / known.mean[index]


def place(index: Tensor, window: int) -> int | None:
    """Where a window is in a list of windows."""
    found = (index == window).nonzero()
    return int(found[0]) if len(found) else None
