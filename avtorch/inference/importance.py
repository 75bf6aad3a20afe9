"""Weighted draws of a posterior by adaptive importance sampling: for a density of which a value is cheap and a gradient
dear.

Proposals are mixtures of Student's t, first around the mode, then around the weighted draws so far; every draw is
weighed by the mixture of all proposals (adaptive multiple importance sampling, Cornuet et al., Scand. J. Statist. 39,
2012). Draws are independent, so a window needs some thousand values of the density where chains of SGLD take tens of
thousands of gradients. Where the weights are not reliable (`pareto_k`), the window does not count as converged.

How heavy the tail of the weights is: the shape of a generalised Pareto law fitted to the largest of them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from avtorch.arrays import Bool, Float, FloatArray
from avtorch.errors import InputError
from avtorch.inference.density import Density
from avtorch.inference.device import check_generator
from avtorch.inference.map import Mode, find_mode

RELIABLE = 0.7
"""Above this shape a mean weighted by the ratios is unreliable for any number of them (Vehtari et al. 2024)."""


def reliable(draws: int) -> float:
    """The shape up to which a mean weighted by this many ratios is reliable: of 512 draws 0.63, of 2154 or more
    `RELIABLE` (Vehtari et al. 2024, section 3.2.3)."""
    return min(1 - 1 / math.log10(draws), RELIABLE) if draws > 10 else -math.inf


def pareto_k(log_ratio: Float[Tensor, "draw window"]) -> Float[Tensor, " window"]:
    """Shape ``k`` of the tail of ratios given by their logarithm ``(draw, window)``; returns ``(window,)``.

    Ratios have finite moments up to order ``1/k``. Of ``n`` of them the ``min(n/5, 3 sqrt n)`` largest are fitted, as
    in Pareto-smoothed importance sampling (Vehtari et al., JMLR 25(72), 2024). Infinite where a ratio is NaN or all
    are zero; minus infinity where the largest are all alike.
    """
    tail = max(5, math.ceil(min(len(log_ratio) / 5, 3 * len(log_ratio) ** 0.5)))
    lost = log_ratio.isnan()
    largest = log_ratio.masked_fill(lost, -torch.inf).topk(tail + 1, 0).values.double().cpu().numpy()
    with np.errstate(all="ignore"):  # where all are zero, or alike
        ratio = np.nan_to_num(np.exp(largest - largest[0]), nan=0.0)
        excess = (ratio[:-1] - ratio[-1])[::-1]  # ascending
        alike = excess[-1] < 1e-12
        k = np.where(alike, -np.inf, _shape(np.where(alike, 1.0, excess)))
    k[lost.any(0).cpu().numpy() | ~np.isfinite(largest[0])] = np.inf
    return torch.from_numpy(k).to(log_ratio)


def _shape(x: FloatArray) -> FloatArray:
    """Shape of a generalised Pareto law (Zhang and Stephens, Technometrics 51, 2009); ``x`` ``(n, window)`` rises.

    The posterior mean over a grid of its other parameter, and a weak prior at 0.5 that weighs as much as ten ratios.
    """
    n = len(x)
    count = 30 + int(n**0.5)
    steps = 1 - np.sqrt(count / (np.arange(1, count + 1) - 0.5))
    quarter = np.maximum(x[int(n / 4 + 0.5) - 1], 1e-300)
    b = steps[:, None] / (3 * quarter) + 1 / x[-1]
    k = np.log1p(-b[:, None] * x).mean(1)
    profile = np.nan_to_num(n * (np.log(-b / k) - k - 1), nan=-np.inf)
    weight = np.exp(profile - profile.max(0))
    b = (weight * b).sum(0) / weight.sum(0)
    return (n * np.log1p(-b * x).mean(0) + 5) / (n + 10)


@dataclass(frozen=True)
class ImportanceSettings:
    """Settings of `weighted_draws`.

    Attributes:
        draws: per round.
        rounds: the most that are made.
        enough: effective draws with which a window is done. 400 leave a mean 0.05 SD uncertain and an SD 4 %.
        degrees: of freedom of the proposals' tails.
        width: SDs of a proposal over those it is fitted to. With narrower ones and lighter tails, intervals of 90 %
            held 1 % less of a long reference's mass; with these, half a per cent.

    Raises `InputError` naming the setting that is out of range.
    """

    draws: int = 256
    rounds: int = 8
    enough: float = 400.0
    degrees: int = 5
    width: float = 1.25

    def __post_init__(self) -> None:
        for name, least in (("draws", 100), ("rounds", 1), ("degrees", 3)):
            if getattr(self, name) < least:
                raise InputError(f"{name}: {getattr(self, name)} is less than {least}")
        if self.draws % 2:
            raise InputError(f"draws: {self.draws} is odd; they come in pairs")
        for name in ("enough", "width"):
            if not getattr(self, name) > 0:
                raise InputError(f"{name}: {getattr(self, name)} is not positive")


@dataclass(frozen=True)
class WeightedDraws:
    """Draws of every window with their weights.

    Attributes:
        z: ``(draw, window, parameter)``, unconstrained.
        weight: ``(draw, window)``, of sum 1 over the draws.
        pareto_k: shape of the tail of the weights, ``(window,)``.
        effective: effective number of draws, ``1 / Σ weight²``, ``(window,)``.
    """

    z: Float[Tensor, "draw window parameter"]
    weight: Float[Tensor, "draw window"]
    pareto_k: Float[Tensor, " window"]
    effective: Float[Tensor, " window"]

    def converged(self, settings: ImportanceSettings) -> Bool[Tensor, " window"]:
        """Where the weights are reliable and at least half of the effective draws aimed at, ``(window,)`` bool.

        With a quarter of them, and one threshold of ``pareto_k`` for any number of draws, intervals of 90 % of windows
        near the thresholds held the truth in 85 %.
        """
        return (self.pareto_k < reliable(len(self.z))) & (self.effective >= 0.5 * settings.enough)

    def moments(self) -> tuple[Float[Tensor, "window parameter"], Float[Tensor, "window parameter parameter"]]:
        """Mean and covariance of ``z``."""
        return _moments(self.z, self.weight)

    def quantile(self, q: float) -> Float[Tensor, "window parameter"]:
        """Quantiles of ``z``: linear in the weight between the middles of neighbouring draws."""
        z, order = self.z.sort(0)
        weight = self.weight[..., None].expand_as(z).gather(0, order)
        level = weight.cumsum(0) - 0.5 * weight
        above = (level < q).sum(0, keepdim=True).clamp(1, len(z) - 1)
        low, high = level.gather(0, above - 1), level.gather(0, above)
        share = ((q - low) / (high - low).clamp_min(1e-300)).clamp(0.0, 1.0)
        return torch.lerp(z.gather(0, above - 1), z.gather(0, above), share)[0]

    def equal(self, count: int, generator: torch.Generator) -> Float[Tensor, "count window parameter"]:
        """``count`` equally weighted draws of ``z``, by systematic resampling; a heavy draw comes more than once."""
        like: dict[str, Any] = {"dtype": self.z.dtype, "device": self.z.device}
        begin = torch.rand(self.z.shape[1], 1, generator=generator, **like)
        at = (torch.arange(count, **like) + begin) / count
        index = torch.searchsorted(self.weight.cumsum(0).mT.contiguous(), at).clamp_max(len(self.z) - 1).mT
        # in random order, so that any leading stretch is a sample
        index = index[torch.randperm(count, generator=generator, device=self.z.device)]
        return self.z.gather(0, index[..., None].expand(-1, -1, self.z.shape[-1]))


class _Mixture:
    """Student's t proposals of all rounds, of equal numbers of draws."""

    def __init__(self, settings: ImportanceSettings) -> None:
        self.settings = settings
        self.parts: list[tuple[Tensor, Tensor]] = []
        self.logs: list[Tensor] = []

    def add(self, mean: Tensor, root: Tensor, generator: torch.Generator | None) -> Tensor:
        """A further proposal with this mean and root of covariance; returns draws of it, ``(draw, window, d)``."""
        settings = self.settings
        root = settings.width * root
        self.parts.append((mean, root))
        self.logs.append(mean.new_empty(0, len(mean)))
        like: dict[str, Any] = {"dtype": mean.dtype, "device": mean.device}
        normal = torch.randn(settings.draws // 2, *mean.shape, generator=generator, **like)
        normal = torch.cat([normal, -normal])  # antithetic: the mean of a symmetric part is free of error
        chi = torch.randn(len(normal), len(mean), settings.degrees, generator=generator, **like)
        stretch = (settings.degrees / chi.square().sum(-1)).sqrt()
        return mean + stretch[..., None] * torch.einsum("wij,nwj->nwi", root, normal)

    def log_prob(self, z: Tensor) -> Tensor:
        """Log density ``(draw, window)`` of the mixture, up to a constant, at the draws of all rounds so far.

        What earlier rounds found for earlier draws is kept.
        """
        for i, (mean, root) in enumerate(self.parts):
            new = z[len(self.logs[i]) :]
            self.logs[i] = torch.cat([self.logs[i], self._student(new, mean, root)])
        return torch.stack(self.logs).logsumexp(0) - math.log(len(self.logs))

    def _student(self, z: Tensor, mean: Tensor, root: Tensor) -> Tensor:
        nu, d = self.settings.degrees, z.shape[-1]
        distance = torch.einsum("wij,nwj->nwi", torch.linalg.inv(root), z - mean).square().sum(-1)
        log_det = root.diagonal(dim1=-2, dim2=-1).abs().log().sum(-1)
        return -0.5 * (nu + d) * torch.log1p(distance / nu) - log_det


@torch.no_grad()
def weighted_draws(
    density: Density,
    settings: ImportanceSettings | None = None,
    *,
    generator: torch.Generator | None = None,
    mode: Mode | None = None,
) -> WeightedDraws:
    """Weighted draws from the posterior of every window, with proposals around ``mode``, sought where not given."""
    settings = ImportanceSettings() if settings is None else settings
    mode = find_mode(density, from_values=True, tolerance=5e-5) if mode is None else mode
    check_generator(generator, mode.z.device)
    mean, root, mixture = mode.z, mode.scale, _Mixture(settings)
    z, target = mean.new_empty(0, *mean.shape), mean.new_empty(0, len(mean))
    for k in range(settings.rounds):
        if k:
            mean, root = _fitted(z, _tempered(target - mixture.log_prob(z)), root)
        fresh = mixture.add(mean, root, generator)
        z = torch.cat([z, fresh])
        found = density.log_prob(fresh)
        target = torch.cat([target, torch.where(found.isfinite(), found, -torch.inf)])
        log_ratio = target - mixture.log_prob(z)
        weight = log_ratio.softmax(0)
        effective = 1 / weight.square().sum(0)
        if k and bool((effective >= settings.enough).all()):
            break
    return WeightedDraws(z, weight, pareto_k(log_ratio), effective)


def _tempered(log_ratio: Tensor, least: float = 40.0) -> Tensor:
    """Weights flattened by a power until ``least`` of them count: few draws do not determine a covariance."""
    power = torch.ones_like(log_ratio[0])
    for _ in range(6):
        weight = (power * log_ratio).nan_to_num(nan=-torch.inf, neginf=-torch.inf).softmax(0)
        power = torch.where(1 / weight.square().sum(0) < least, 0.6 * power, power)
    return weight


def _moments(z: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    mean = (weight[..., None] * z).sum(0)
    centred = z - mean
    return mean, torch.einsum("nw,nwi,nwj->wij", weight, centred, centred)


def _fitted(z: Tensor, weight: Tensor, before: Tensor) -> tuple[Tensor, Tensor]:
    """Mean and root of covariance of weighted draws; the root ``before`` where they have none."""
    mean, covariance = _moments(z, weight)
    root, lost = torch.linalg.cholesky_ex(covariance)
    return mean, torch.where((lost == 0)[:, None, None], root, before)
