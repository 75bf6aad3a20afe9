"""Settings of the sampler, with the reasons for their defaults in benchmarks/bias/README.md."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import torch
from torch import Tensor
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LRScheduler

from avtorch.errors import InputError
from avtorch.inference.coordinates import Whitening
from avtorch.inference.sgld import Noise

MakeOptimizer = Callable[[list[Tensor], float, torch.Generator | None], Optimizer]


@dataclass(frozen=True)
class SamplerSettings:
    """Settings of Algorithm 1. The space is whitened by the Laplace covariance at the mode, so one step fits every car.

    A window whose posterior is skewed gets a shorter step and in proportion more of them (:func:`stiffness`), so that
    every window gets about the same number of effective draws: a new car needs no tuning.

    Attributes:
        chains: chains per window.
        draws: draws collected per chain, after burn-in and thinning.
        burn_in: steps dropped at the start (the paper's ``c``).
        thinning: steps per collected draw.
        step: ``h`` in the whitened space. With averaged noise the autocorrelation of a Gaussian is ``1 - h/2`` a step.
        noise: see :class:`SGLD`.
        batch: points per minibatch, or ``None`` for the whole window.
        spread: chains start this many posterior SDs around the mode; 0 starts them at the mode.
        schedule: makes a learning-rate scheduler from the optimizer, or ``None`` for a constant step.
        longest: maximum factor of steps for a skewed window; a low value saves time where a step is expensive, but then
            the most skewed windows do not mix.
        attempts: how often a window whose chains diverge, disagree or miss the density is run again with half the step.
        whitening: ``"full"``, or for comparison ``"diagonal"`` or ``"none"`` (see :class:`Coordinates`).
        optimizer: makes another optimizer than SGLD from ``(parameters, step, generator)``.
        compare: compare the draws with the exact density (:mod:`avtorch.inference.exactness`), also with a minibatch, a
            schedule or another optimizer. Set it to false only for a density too expensive to evaluate at some hundred
            points; ``converged`` then means only that the chains agree with each other.
        walk: ``"auto"`` compiles the walk where density and settings allow it (:mod:`avtorch.inference.compiled`),
            ``"eager"`` always steps with :class:`SGLD`, the reference. Both have the same law; a seed gives each
            its own draws.

    Raises `InputError` naming the setting that is out of range.

    Example:
        >>> from avtorch.inference import SamplerSettings
        >>> few_long = SamplerSettings(chains=4, draws=2000, burn_in=500)  # for `sample` or `SequentialInference`
        >>> slower = few_long.slower(2.0)
        >>> slower.step, slower.burn_in, slower.thinning
        (2.0, 2000, 4)
    """

    chains: int = 1024
    draws: int = 8
    burn_in: int = 8
    thinning: int = 2
    step: float = 2.0
    noise: Noise = "averaged"
    batch: int | None = None
    spread: float = 0.0
    schedule: Callable[[Optimizer], LRScheduler] | None = None
    longest: float = 64.0
    attempts: int = 4
    whitening: Whitening = "full"
    optimizer: MakeOptimizer | None = None
    compare: bool = True
    walk: Literal["auto", "eager"] = "auto"

    def __post_init__(self) -> None:
        for name, least in (("chains", 1), ("draws", 4), ("burn_in", 0), ("thinning", 1), ("attempts", 1)):
            if getattr(self, name) < least:
                raise InputError(f"{name}: {getattr(self, name)} is less than {least}")
        if not 0 < self.step < 4:
            raise InputError(f"step: {self.step} is not in (0, 4), where the whitened step is stable")
        if not 0 <= self.spread < float("inf"):
            raise InputError(f"spread: {self.spread} is not a finite number of posterior SDs, 0 or more")
        if self.batch is not None and self.batch < 1:
            raise InputError(f"batch: {self.batch} is less than 1")
        if not self.longest >= 1:
            raise InputError(f"longest: {self.longest} is not 1 or more")
        if self.whitening not in ("full", "diagonal", "none"):
            raise InputError(f"whitening: {self.whitening!r} is none of 'full', 'diagonal', 'none'")
        if self.walk not in ("auto", "eager"):
            raise InputError(f"walk: {self.walk!r} is neither 'auto' nor 'eager'")

    def slower(self, times: float) -> SamplerSettings:
        """The same settings with ``times`` as many steps, for a step that is ``times`` shorter.

        A posterior that is steep on one side is flat on the other, which chains reach even later: the burn-in grows
        further.
        """
        times = min(times, self.longest)
        burn_in = math.ceil(times * min(times, 5.0) * self.burn_in)
        return replace(self, burn_in=burn_in, thinning=math.ceil(times * self.thinning))
