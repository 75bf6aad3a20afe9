"""A form of the log density: which rows it takes, and the likelihood that it gives of a window of them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Protocol

from torch import Tensor

from avtorch.arrays import Bool, Real
from avtorch.inference.density import Density
from avtorch.inference.priors import Prior
from avtorch.inference.sampler_settings import SamplerSettings

Rows = Mapping[str, Tensor]
"""One window: ``time`` ``(time,)`` [s] and ``usable`` and the measured columns, each ``(vehicle, time)``."""


@dataclass(frozen=True)
class WindowLikelihood:
    """The likelihood of one window of every vehicle: with a prior it gives a posterior density.

    `n`: usable rows, ``(vehicle,)``. `excited`: ``(vehicle,)`` bool, by the fixed rule. `density`: the posterior
    density of the vehicles named by an index, from their priors.
    """

    n: Real[Tensor, " vehicle"]
    excited: Bool[Tensor, " vehicle"]
    density: Callable[[Tensor, Prior], Density]


class Form(Protocol):
    """A form of the log density: its columns, its parameters, and the likelihood of a window of rows."""

    @property
    def names(self) -> tuple[str, ...]: ...

    @property
    def columns(self) -> tuple[str, ...]: ...

    @property
    def noise_prior(self) -> Prior: ...

    @property
    def sampler(self) -> SamplerSettings:
        """Default settings of the sampler for its posteriors."""
        ...

    def likelihood(self, rows: Rows, full: float) -> WindowLikelihood:
        """The likelihood of a window; ``full`` is the number of rows of a complete one."""
        ...
