"""Algorithm 1 of the paper: walk with SGLD, drop the burn-in, collect the rest; chains and windows in one tensor."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import cast

import torch
from torch import Tensor
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LRScheduler

from avtorch.errors import InputError
from avtorch.inference.density import Density, ScoredDensity, SubsampledDensity
from avtorch.inference.map import Mode, find_mode
from avtorch.inference.posterior import Posterior, nested_rhat
from avtorch.inference.sgld import SGLD, Noise


@dataclass(frozen=True)
class SamplerSettings:
    """How Algorithm 1 walks. The space is whitened by the Laplace covariance at the mode, so one step fits every car.

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
        attempts: how often a window whose chains diverge or disagree is run again with half the step.
    """

    chains: int = 64
    draws: int = 60
    burn_in: int = 15
    thinning: int = 1
    step: float = 1.5
    noise: Noise = "averaged"
    batch: int | None = None
    spread: float = 0.0
    schedule: Callable[[Optimizer], LRScheduler] | None = None
    attempts: int = 4

    def __post_init__(self) -> None:
        for name, least in (("chains", 1), ("draws", 4), ("burn_in", 0), ("thinning", 1), ("attempts", 1)):
            if getattr(self, name) < least:
                raise InputError(f"{name}: {getattr(self, name)} is less than {least}")
        if not 0 < self.step < 4:
            raise InputError(f"step: {self.step} is not in (0, 4), where the whitened step is stable")
        if self.spread < 0:
            raise InputError(f"spread: {self.spread} is negative")
        if self.batch is not None and self.batch < 1:
            raise InputError(f"batch: {self.batch} is less than 1")


def sample(
    density: Density,
    settings: SamplerSettings | None = None,
    *,
    generator: torch.Generator | None = None,
    mode: Mode | None = None,
    rhat_max: float = 1.1,
) -> Posterior:
    """Draws from the posterior of every window (Algorithm 1).

    A window whose chains leave the finite numbers or the posterior, or end with a nested R-hat above ``rhat_max``, is
    sampled again, with half the step and twice the steps; one that never settles comes back with ``converged`` false.

    Args:
        density: the target, over ``z = log(parameter)``.
        mode: its mode and curvature, if known.
    """
    settings = SamplerSettings() if settings is None else settings
    mode = find_mode(density) if mode is None else mode

    def unsettled(draws: Tensor) -> Tensor:
        rhat = nested_rhat(draws).amax(-1)
        return ~(rhat <= rhat_max) | _strayed(density, mode, draws)  # NaN is trouble, too

    draws = walk(density, mode, settings, generator=generator)
    trouble = unsettled(draws)
    slower = settings
    for _ in range(settings.attempts - 1):
        if not bool(trouble.any()):
            break
        slower = replace(slower, step=slower.step / 2, burn_in=2 * slower.burn_in, thinning=2 * slower.thinning)
        again = walk(density, mode, slower, generator=generator)
        draws = torch.where(trouble[:, None], again, draws)
        trouble = trouble & unsettled(again)
    return Posterior(density.names, draws.exp(), mode.converged & ~trouble)


def _strayed(density: Density, mode: Mode, draws: Tensor, depth: float = 200.0) -> Tensor:
    """Where some chain's furthest draw lies ``depth`` nats off the mode, ``(window,)`` bool.

    R-hat alone overlooks the few chains that diverge: they blow up the variance within as much as that between.
    A draw of the posterior lies ``chi^2/2`` nats deep, so 200 is out of reach even for a tenfold variance.
    """
    whitened = torch.einsum("wij,cnwj->cnwi", torch.linalg.inv(mode.scale), draws - mode.z)
    furthest = whitened.square().sum(-1).nan_to_num(nan=torch.inf).argmax(1)
    with torch.no_grad():
        far = draws.take_along_dim(furthest[:, None, :, None], dim=1).squeeze(1)
        return ~((mode.log_prob - density.log_prob(far)).abs() <= depth).all(0)


def stiffness(density: Density, mode: Mode, radius: float = 3.0) -> Tensor:
    """How much steeper than its Laplace approximation the whitened potential gets ``radius`` SDs out.

    Shape ``(window,)``, at least 1.
    A skewed posterior (a weak window) has a steep side on which the step that suits the mode overshoots; dividing the
    window's step by this keeps ``step x curvature`` what it is at the mode of a Gaussian.
    """
    d = mode.z.shape[-1]
    axes = radius * torch.eye(d, dtype=mode.z.dtype)
    probes = torch.cat([axes, -axes])[:, None, :].expand(-1, mode.z.shape[0], d).clone().requires_grad_()
    potential = -density.log_prob(mode.z + torch.einsum("wij,cwj->cwi", mode.scale, probes))
    (gradient,) = torch.autograd.grad(potential.sum(), probes)
    slope = torch.einsum("cwi,cwi->cw", gradient, probes.detach()) / radius**2
    return slope.nan_to_num(posinf=1e6).amax(0).clamp(1.0, 1e6)


def walk(
    density: Density, mode: Mode, settings: SamplerSettings, *, generator: torch.Generator | None = None
) -> Tensor:
    """One run of Algorithm 1 in the whitened coordinates ``z = mode + scale w``.

    Returns draws of ``z``, ``(chain, draw, window, d)``. A step ``h`` in ``w`` is a step 1 in ``w/sqrt(h)``, so each
    window's own step is folded into its scale.
    """
    scale = mode.scale / stiffness(density, mode).sqrt()[:, None, None]
    shape = (settings.chains, *mode.z.shape)
    start = torch.zeros(shape, dtype=mode.z.dtype)
    if settings.spread > 0:
        start = settings.spread * torch.randn(shape, dtype=mode.z.dtype, generator=generator)
        start = torch.einsum("wij,cwj->cwi", torch.linalg.solve(scale, mode.scale), start)
    w = start.requires_grad_()
    optimizer = SGLD([w], settings.step, noise=settings.noise, generator=generator)
    scheduler = None if settings.schedule is None else settings.schedule(optimizer)

    def potential() -> Tensor:
        z = mode.z + torch.einsum("wij,cwj->cwi", scale, w)
        if settings.batch is None:
            return -density.log_prob(z).sum()
        if not isinstance(density, SubsampledDensity):
            raise InputError(f"batch: {type(density).__name__} has no minibatch estimate; leave batch at None")
        index = torch.randint(density.points, (settings.batch,), generator=generator)
        return -density.log_prob_minibatch(z, index).sum()

    def scored_potential() -> None:
        # a density that knows its own gradient saves the graph: half the time of a small window's step
        z = mode.z + torch.bmm(w.detach().transpose(0, 1), scale.mT).transpose(0, 1)
        score = cast(ScoredDensity, density).score(z)
        w.grad = -torch.bmm(score.transpose(0, 1), scale).transpose(0, 1)

    closure = scored_potential if settings.batch is None and isinstance(density, ScoredDensity) else potential

    kept = torch.empty(settings.draws, *shape, dtype=mode.z.dtype)
    for k in range(settings.burn_in + settings.draws * settings.thinning):
        optimizer.step(closure)
        if scheduler is not None:
            scheduler.step()
        collected = k + 1 - settings.burn_in
        if collected > 0 and collected % settings.thinning == 0:
            kept[collected // settings.thinning - 1] = w.detach()
    return mode.z + torch.einsum("wij,cnwj->cnwi", scale, kept.transpose(0, 1))
