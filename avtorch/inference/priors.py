"""Priors, stated on the positive parameters and evaluated in ``z = log(parameter)`` with the Jacobian included.

Defaults: ``T_L ~ LogNormal(log 0.3, 0.7)``, ``K_L ~ LogNormal(log 1, 0.3)``,
``sigma ~ HalfNormal(1 m/s^3)``.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass, fields
from typing import Any, Self, TypeAlias

import torch
from torch import Tensor

from avtorch.arrays import Bool, Float, Int
from avtorch.errors import InputError
from avtorch.inference.density import PotentialTerms
from avtorch.vehicle.arguments import broadcast_shape

_LOG_2PI = math.log(2 * math.pi)

Draws: TypeAlias = Float[Tensor, "count window parameter"]


@dataclass(frozen=True)
class Prior(ABC):
    """A prior of every window, over the last dimension of ``z``: its potential terms, and draws of it."""

    @abstractmethod
    def terms(self, windows: int) -> PotentialTerms:
        """Minus its log density, of so many windows."""

    @abstractmethod
    def sample(self, count: int, windows: int, *, generator: torch.Generator | None = None) -> Draws:
        """Draws of ``z``, shape ``(count, window, parameter)``."""

    @abstractmethod
    def center(self) -> Float[Tensor, "*window parameter"]:
        """A typical ``z``, shape broadcastable to ``(window, parameter)``."""

    def select(self, index: Int[Tensor, " chosen"] | Bool[Tensor, " window"]) -> Prior:
        """That of the windows named by ``index``."""
        return self

    def log_prob(self, z: Float[Tensor, "*draw window parameter"]) -> Float[Tensor, "*draw window"]:
        """Log density, ``(..., window)``."""
        return -self.terms(z.shape[-2]).potential(z)

    def score(self, z: Float[Tensor, "*draw window parameter"]) -> Float[Tensor, "*draw window parameter"]:
        """Gradient of ``log_prob``, shape of ``z``."""
        return -self.terms(z.shape[-2]).slope(z)

    @property
    def device(self) -> torch.device:
        return next(x.device for x in self._given() if isinstance(x, Tensor | Prior))

    def to(self, device: torch.device) -> Self:
        """The prior on a device."""
        if self.device == device:
            return self
        return type(self)(*(x.to(device) if isinstance(x, Tensor | Prior) else x for x in self._given()))

    def _given(self) -> list[Any]:
        return [getattr(self, f.name) for f in fields(self)]


@dataclass(frozen=True)
class LogNormalPrior(Prior):
    """Independent log-normal parameters: ``log(parameter) ~ Normal(log median, log_sd)``; shapes ``(parameter,)``."""

    median: Float[Tensor, " parameter"]
    log_sd: Float[Tensor, " parameter"]

    def __post_init__(self) -> None:
        for name in ("median", "log_sd"):
            object.__setattr__(self, name, _positive(name, getattr(self, name)))

    def terms(self, windows: int) -> PotentialTerms:
        d, precision = len(self.median), self.log_sd.square().reciprocal()
        constant = self.log_sd.log().sum() + 0.5 * d * _LOG_2PI
        return PotentialTerms.of(windows, d, constant=constant, center=self.median.log(), quadratic=precision.diag())

    def sample(self, count: int, windows: int, *, generator: torch.Generator | None = None) -> Draws:
        noise = torch.randn(count, windows, len(self.median), generator=generator, **_like(self.median))
        return self.median.log() + self.log_sd * noise

    def center(self) -> Float[Tensor, " parameter"]:
        return self.median.log()


@dataclass(frozen=True)
class HalfNormalPrior(Prior):
    """Independent half-normal parameters with the given ``scale``, shape ``(parameter,)``."""

    scale: Float[Tensor, " parameter"]

    def __post_init__(self) -> None:
        object.__setattr__(self, "scale", _positive("scale", self.scale))

    def terms(self, windows: int) -> PotentialTerms:
        d, square = len(self.scale), self.scale.square().reciprocal()
        constant = self.scale.log().sum() - 0.5 * d * math.log(2 / math.pi)
        return PotentialTerms.of(windows, d, constant=constant, linear=-1.0, own_square=square)

    def sample(self, count: int, windows: int, *, generator: torch.Generator | None = None) -> Draws:
        noise = torch.randn(count, windows, len(self.scale), generator=generator, **_like(self.scale))
        return (self.scale * noise.abs()).log()

    def center(self) -> Float[Tensor, " parameter"]:
        return (0.5 * self.scale).log()


@dataclass(frozen=True)
class QuadrantNormal(Prior):
    """Normal of ``variance`` around ``mean``, cut to the positive quadrant: the paper's ``N([K, T], lambda I)``.

    The paper (Sec. 3.2.3) does not define the mass below zero; here it is cut off and the rest renormalised.

    `mean`: shape ``(window, parameter)``, in the parameters' own units. `variance`: ``lambda``, in the squared units of
    each parameter.
    """

    mean: Float[Tensor, "window parameter"]
    variance: float

    def __post_init__(self) -> None:
        if not self.variance > 0:
            raise InputError(f"variance (lambda): {self.variance} is not positive")

    def terms(self, windows: int) -> PotentialTerms:
        d, precision = self.mean.shape[-1], 1 / self.variance
        log_mass = torch.special.log_ndtr(self.mean / math.sqrt(self.variance)).sum(-1)
        norm = 0.5 * d * (_LOG_2PI + math.log(self.variance))
        constant = 0.5 * precision * self.mean.square().sum(-1) + log_mass + norm
        own = {"own_linear": -precision * self.mean, "own_square": precision}
        return PotentialTerms.of(windows, d, constant=constant, linear=-1.0, **own)

    def select(self, index: Int[Tensor, " chosen"] | Bool[Tensor, " window"]) -> QuadrantNormal:
        return QuadrantNormal(self.mean[index], self.variance)

    def sample(self, count: int, windows: int, *, generator: torch.Generator | None = None) -> Draws:
        # inverse CDF of the part above zero: exact, with a fixed number of uniforms
        uniform = torch.rand(count, windows, self.mean.shape[-1], generator=generator, **_like(self.mean))
        sd = math.sqrt(self.variance)
        below = torch.special.ndtr(-self.mean / sd)
        cut = (below + (1 - below) * uniform).clamp(1e-300, 1 - 1e-16)
        return (self.mean + sd * torch.special.ndtri(cut)).clamp_min(1e-12).log()

    def center(self) -> Float[Tensor, "window parameter"]:
        return self.mean.clamp_min(1e-3).log()


@dataclass(frozen=True)
class LogSpaceNormal(Prior):
    """Normal in ``z`` with full covariance: the whole posterior of a window as the prior of the next.

    `mean_z`: shape ``(window, parameter)``. `cov_z`: shape ``(window, parameter, parameter)``.
    """

    mean_z: Float[Tensor, "window parameter"]
    cov_z: Float[Tensor, "window parameter parameter"]

    def terms(self, windows: int) -> PotentialTerms:
        d, lower = self.mean_z.shape[-1], torch.linalg.cholesky(self.cov_z)
        constant = lower.diagonal(dim1=-2, dim2=-1).log().sum(-1) + 0.5 * d * _LOG_2PI
        quadratic = torch.cholesky_inverse(lower)
        return PotentialTerms.of(windows, d, constant=constant, center=self.mean_z, quadratic=quadratic)

    def select(self, index: Int[Tensor, " chosen"] | Bool[Tensor, " window"]) -> LogSpaceNormal:
        return LogSpaceNormal(self.mean_z[index], self.cov_z[index])

    def sample(self, count: int, windows: int, *, generator: torch.Generator | None = None) -> Draws:
        noise = torch.randn(count, windows, self.mean_z.shape[-1], generator=generator, **_like(self.mean_z))
        return self.mean_z + torch.einsum("wij,cwj->cwi", torch.linalg.cholesky(self.cov_z), noise)

    def center(self) -> Float[Tensor, "window parameter"]:
        return self.mean_z


@dataclass(frozen=True)
class Joint(Prior):
    """Independent blocks: ``actuation`` over ``(T_L, K_L)``, the first two parameters, and ``noise`` over the rest."""

    actuation: Prior
    noise: Prior

    def terms(self, windows: int) -> PotentialTerms:
        return self.actuation.terms(windows).beside(self.noise.terms(windows))

    def select(self, index: Int[Tensor, " chosen"] | Bool[Tensor, " window"]) -> Joint:
        return Joint(self.actuation.select(index), self.noise.select(index))

    def sample(self, count: int, windows: int, *, generator: torch.Generator | None = None) -> Draws:
        parts = [part.sample(count, windows, generator=generator) for part in (self.actuation, self.noise)]
        return torch.cat(parts, dim=-1)

    def center(self) -> Float[Tensor, "*window parameter"]:
        first, rest = self.actuation.center(), self.noise.center()
        shape = broadcast_shape(first.shape[:-1], rest.shape[:-1])
        return torch.cat([first.expand(*shape, -1), rest.expand(*shape, -1)], dim=-1)


@dataclass(frozen=True)
class Switch(Prior):
    """Window by window one of two priors: ``later`` where ``started``, shape ``(window,)``, else ``first``."""

    started: Bool[Tensor, " window"]
    first: Prior
    later: Prior

    def terms(self, windows: int) -> PotentialTerms:
        return self.later.terms(windows).where(self.started, self.first.terms(windows))

    def select(self, index: Int[Tensor, " chosen"] | Bool[Tensor, " window"]) -> Prior:
        started = self.started[index]
        first, later = self.first.select(index), self.later.select(index)
        if bool(started.all()):
            return later
        return Switch(started, first, later) if bool(started.any()) else first

    def sample(self, count: int, windows: int, *, generator: torch.Generator | None = None) -> Draws:
        first = self.first.sample(count, windows, generator=generator)
        later = self.later.sample(count, windows, generator=generator)
        return torch.where(self.started[:, None], later, first)

    def center(self) -> Float[Tensor, "window parameter"]:
        return torch.where(self.started[:, None], self.later.center(), self.first.center())


def _positive(name: str, value: Any) -> Tensor:
    checked = torch.as_tensor(value, dtype=torch.float64)
    if not bool((checked > 0).all()):
        raise InputError(f"{name}: {checked.tolist()} is not positive")
    return checked


def _like(x: Tensor) -> dict[str, Any]:
    return {"dtype": torch.float64, "device": x.device}


def default_actuation_prior() -> LogNormalPrior:
    """The first prior of ``(T_L [s], K_L [-])``."""
    return LogNormalPrior(torch.tensor([0.3, 1.0], dtype=torch.float64), torch.tensor([0.7, 0.3], dtype=torch.float64))


def default_jerk_noise_prior() -> HalfNormalPrior:
    """The prior of ``sigma`` [m/s^3] for every window."""
    return HalfNormalPrior(torch.tensor([1.0], dtype=torch.float64))
