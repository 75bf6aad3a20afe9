"""Priors, stated on the positive parameters and evaluated in ``z = log(parameter)`` with the Jacobian included.

Defaults: ``T_L ~ LogNormal(log 0.3, 0.7)``, ``K_L ~ LogNormal(log 1, 0.3)``,
``sigma ~ HalfNormal(1 m/s^3)``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any, Protocol

import torch
from torch import Tensor

from avtorch.arrays import Bool, Float, Int
from avtorch.errors import InputError
from avtorch.inference.exponential_form import PotentialTerms, terms_of
from avtorch.inference.planes import join_planes
from avtorch.vehicle.arguments import broadcast_shape

_LOG_2PI = math.log(2 * math.pi)


class Prior(Protocol):
    """Log density over the last dimension of ``z``; ``select`` keeps the windows named by an index.

    One with a ``device`` and ``to(device)`` follows the data that it is used with; another has to be there already.
    """

    def log_prob(self, z: Float[Tensor, "*draw window parameter"]) -> Float[Tensor, "*draw window"]: ...

    def score(self, z: Float[Tensor, "*draw window parameter"]) -> Float[Tensor, "*draw window parameter"]:
        """Gradient of ``log_prob``, shape of ``z``."""
        ...

    def select(self, index: Int[Tensor, " chosen"] | Bool[Tensor, " window"]) -> Prior: ...

    def sample(
        self, count: int, windows: int, *, generator: torch.Generator | None = None
    ) -> Float[Tensor, "count window parameter"]:
        """Draws of ``z``, shape ``(count, window, parameter)``."""
        ...

    def center(self) -> Float[Tensor, "*window parameter"]:
        """A typical ``z``, shape broadcastable to ``(window, parameter)``."""
        ...


@dataclass(frozen=True)
class LogNormalPrior:
    """Independent log-normal parameters: ``log(parameter) ~ Normal(log median, log_sd)``; shapes ``(parameter,)``."""

    median: Float[Tensor, " parameter"]
    log_sd: Float[Tensor, " parameter"]
    _log_median: Float[Tensor, " parameter"] = field(init=False, repr=False)
    _precision: Float[Tensor, " parameter"] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        for name in ("median", "log_sd"):
            value = torch.as_tensor(getattr(self, name), dtype=torch.float64)
            if not bool((value > 0).all()):
                raise InputError(f"{name}: {value.tolist()} is not positive")
            object.__setattr__(self, name, value)
        object.__setattr__(self, "_log_median", self.median.log())
        object.__setattr__(self, "_precision", self.log_sd.square().reciprocal())

    def log_prob(self, z: Float[Tensor, "*draw parameter"]) -> Float[Tensor, "*draw"]:
        score = (z - self.median.log()) / self.log_sd
        return -0.5 * score.square().sum(-1) - self.log_sd.log().sum() - 0.5 * len(self.median) * _LOG_2PI

    def score(self, z: Float[Tensor, "*draw parameter"]) -> Float[Tensor, "*draw parameter"]:
        return (self._log_median - z).mul_(self._precision)

    def potential_terms(self, windows: int) -> PotentialTerms:
        half = 0.5 * (self._precision * self._log_median.square()).sum()
        constant = half + self.log_sd.log().sum() + 0.5 * len(self.median) * _LOG_2PI
        linear, quadratic = -self._precision * self._log_median, self._precision.diag()
        return PotentialTerms.of(windows, len(self.median), constant=constant, linear=linear, quadratic=quadratic)

    @property
    def device(self) -> torch.device:
        return self.median.device

    def to(self, device: torch.device) -> LogNormalPrior:
        return LogNormalPrior(self.median.to(device), self.log_sd.to(device))

    def select(self, index: Int[Tensor, " chosen"] | Bool[Tensor, " window"]) -> LogNormalPrior:
        return self

    def sample(
        self, count: int, windows: int, *, generator: torch.Generator | None = None
    ) -> Float[Tensor, "count window parameter"]:
        noise = torch.randn(count, windows, len(self.median), generator=generator, **_like(self.median))
        return self.median.log() + self.log_sd * noise

    def center(self) -> Float[Tensor, " parameter"]:
        return self.median.log()


@dataclass(frozen=True)
class HalfNormalPrior:
    """Independent half-normal parameters with the given ``scale``, shape ``(parameter,)``."""

    scale: Float[Tensor, " parameter"]
    _minus_precision: Float[Tensor, " parameter"] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        value = torch.as_tensor(self.scale, dtype=torch.float64)
        if not bool((value > 0).all()):
            raise InputError(f"scale: {value.tolist()} is not positive")
        object.__setattr__(self, "scale", value)
        object.__setattr__(self, "_minus_precision", -value.square().reciprocal())

    def log_prob(self, z: Float[Tensor, "*draw parameter"]) -> Float[Tensor, "*draw"]:
        log_density = -0.5 * (z.exp() / self.scale).square() + z
        return log_density.sum(-1) + len(self.scale) * 0.5 * math.log(2 / math.pi) - self.scale.log().sum()

    def score(self, z: Float[Tensor, "*draw parameter"]) -> Float[Tensor, "*draw parameter"]:
        return (2 * z).exp_().mul_(self._minus_precision).add_(1)

    def potential_terms(self, windows: int) -> PotentialTerms:
        constant = self.scale.log().sum() - len(self.scale) * 0.5 * math.log(2 / math.pi)
        square = -self._minus_precision
        return PotentialTerms.of(windows, len(self.scale), constant=constant, linear=-1.0, own_square=square)

    @property
    def device(self) -> torch.device:
        return self.scale.device

    def to(self, device: torch.device) -> HalfNormalPrior:
        return HalfNormalPrior(self.scale.to(device))

    def select(self, index: Int[Tensor, " chosen"] | Bool[Tensor, " window"]) -> HalfNormalPrior:
        return self

    def sample(
        self, count: int, windows: int, *, generator: torch.Generator | None = None
    ) -> Float[Tensor, "count window parameter"]:
        noise = torch.randn(count, windows, len(self.scale), generator=generator, **_like(self.scale))
        return (self.scale * noise.abs()).log()

    def center(self) -> Float[Tensor, " parameter"]:
        return (0.5 * self.scale).log()


@dataclass(frozen=True)
class QuadrantNormal:
    """Normal of ``variance`` around ``mean``, cut to the positive quadrant: the paper's ``N([K, T], lambda I)``.

    The paper (Sec. 3.2.3) does not define the mass below zero; here it is cut off and the rest renormalised.

    `mean`: shape ``(window, parameter)``, in the parameters' own units. `variance`: ``lambda``, in the squared units of
    each parameter.
    """

    mean: Float[Tensor, "window parameter"]
    variance: float
    _log_mass: Float[Tensor, " window"] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        if not self.variance > 0:
            raise InputError(f"variance (lambda): {self.variance} is not positive")
        inside = torch.special.log_ndtr(self.mean / math.sqrt(self.variance)).sum(-1)
        object.__setattr__(self, "_log_mass", inside + 0.5 * self.mean.shape[-1] * (_LOG_2PI + math.log(self.variance)))

    def log_prob(self, z: Float[Tensor, "*draw window parameter"]) -> Float[Tensor, "*draw window"]:
        distance = (z.exp() - self.mean).square().sum(-1)
        return -0.5 / self.variance * distance + z.sum(-1) - self._log_mass

    def score(self, z: Float[Tensor, "*draw window parameter"]) -> Float[Tensor, "*draw window parameter"]:
        value = z.exp()
        return 1 - value * (value - self.mean) / self.variance

    def potential_terms(self, windows: int) -> PotentialTerms:
        return PotentialTerms.of(
            windows,
            self.mean.shape[-1],
            constant=0.5 / self.variance * self.mean.square().sum(-1) + self._log_mass,
            linear=-1.0,
            own_linear=-self.mean / self.variance,
            own_square=1 / self.variance,
        )

    @property
    def device(self) -> torch.device:
        return self.mean.device

    def to(self, device: torch.device) -> QuadrantNormal:
        return QuadrantNormal(self.mean.to(device), self.variance)

    def select(self, index: Int[Tensor, " chosen"] | Bool[Tensor, " window"]) -> QuadrantNormal:
        return QuadrantNormal(self.mean[index], self.variance)

    def sample(
        self, count: int, windows: int, *, generator: torch.Generator | None = None
    ) -> Float[Tensor, "count window parameter"]:
        # inverse CDF of the part above zero: exact, with a fixed number of uniforms
        uniform = torch.rand(count, windows, self.mean.shape[-1], generator=generator, **_like(self.mean))
        sd = math.sqrt(self.variance)
        below = torch.special.ndtr(-self.mean / sd)
        cut = (below + (1 - below) * uniform).clamp(1e-300, 1 - 1e-16)
        return (self.mean + sd * torch.special.ndtri(cut)).clamp_min(1e-12).log()

    def center(self) -> Float[Tensor, "window parameter"]:
        return self.mean.clamp_min(1e-3).log()


@dataclass(frozen=True)
class LogSpaceNormal:
    """Normal in ``z`` with full covariance: the whole posterior of a window as the prior of the next.

    `mean_z`: shape ``(window, parameter)``. `cov_z`: shape ``(window, parameter, parameter)``.
    """

    mean_z: Float[Tensor, "window parameter"]
    cov_z: Float[Tensor, "window parameter parameter"]
    _inverse: Float[Tensor, "window parameter parameter"] = field(init=False, repr=False)
    _half_log_det: Float[Tensor, " window"] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        lower = torch.linalg.cholesky(self.cov_z)
        eye = torch.eye(lower.shape[-1], dtype=lower.dtype, device=lower.device).expand_as(lower)
        object.__setattr__(self, "_inverse", torch.linalg.solve_triangular(lower, eye, upper=False))
        object.__setattr__(self, "_half_log_det", lower.diagonal(dim1=-2, dim2=-1).log().sum(-1))

    def log_prob(self, z: Float[Tensor, "*draw window parameter"]) -> Float[Tensor, "*draw window"]:
        score = torch.einsum("wij,...wj->...wi", self._inverse, z - self.mean_z)
        return -0.5 * score.square().sum(-1) - self._half_log_det - 0.5 * self.mean_z.shape[-1] * _LOG_2PI

    def score(self, z: Float[Tensor, "*draw window parameter"]) -> Float[Tensor, "*draw window parameter"]:
        return -torch.einsum("wji,wjk,...wk->...wi", self._inverse, self._inverse, z - self.mean_z)

    def potential_terms(self, windows: int) -> PotentialTerms:
        d, mean = self.mean_z.shape[-1], self.mean_z
        precision = self._inverse.mT @ self._inverse
        linear = -(precision @ mean[..., None])[..., 0]
        constant = -0.5 * (linear * mean).sum(-1) + self._half_log_det + 0.5 * d * _LOG_2PI
        return PotentialTerms.of(windows, d, constant=constant, linear=linear, quadratic=precision)

    @property
    def device(self) -> torch.device:
        return self.mean_z.device

    def to(self, device: torch.device) -> LogSpaceNormal:
        return LogSpaceNormal(self.mean_z.to(device), self.cov_z.to(device))

    def select(self, index: Int[Tensor, " chosen"] | Bool[Tensor, " window"]) -> LogSpaceNormal:
        return LogSpaceNormal(self.mean_z[index], self.cov_z[index])

    def sample(
        self, count: int, windows: int, *, generator: torch.Generator | None = None
    ) -> Float[Tensor, "count window parameter"]:
        noise = torch.randn(count, windows, self.mean_z.shape[-1], generator=generator, **_like(self.mean_z))
        return self.mean_z + torch.einsum("wij,cwj->cwi", torch.linalg.cholesky(self.cov_z), noise)

    def center(self) -> Float[Tensor, "window parameter"]:
        return self.mean_z


@dataclass(frozen=True)
class Joint:
    """Independent blocks: ``actuation`` over ``(T_L, K_L)``, the first two parameters, and ``noise`` over the rest."""

    actuation: Prior
    noise: Prior

    def log_prob(self, z: Float[Tensor, "*draw window parameter"]) -> Float[Tensor, "*draw window"]:
        return self.actuation.log_prob(z[..., :2]) + self.noise.log_prob(z[..., 2:])

    def score(self, z: Float[Tensor, "*draw window parameter"]) -> Float[Tensor, "*draw window parameter"]:
        return join_planes(self.actuation.score(z[..., :2]), self.noise.score(z[..., 2:]))

    def potential_terms(self, windows: int) -> PotentialTerms | None:
        first, rest = terms_of(self.actuation, windows), terms_of(self.noise, windows)
        return None if first is None or rest is None else first.beside(rest)

    @property
    def device(self) -> torch.device | None:
        return getattr(self.noise, "device", None)

    def to(self, device: torch.device) -> Joint:
        return Joint(prior_on(self.actuation, device), prior_on(self.noise, device))

    def select(self, index: Int[Tensor, " chosen"] | Bool[Tensor, " window"]) -> Joint:
        return Joint(self.actuation.select(index), self.noise.select(index))

    def sample(
        self, count: int, windows: int, *, generator: torch.Generator | None = None
    ) -> Float[Tensor, "count window parameter"]:
        parts = [part.sample(count, windows, generator=generator) for part in (self.actuation, self.noise)]
        return torch.cat(parts, dim=-1)

    def center(self) -> Float[Tensor, "*window parameter"]:
        first, rest = self.actuation.center(), self.noise.center()
        shape = broadcast_shape(first.shape[:-1], rest.shape[:-1])
        return torch.cat([first.expand(*shape, -1), rest.expand(*shape, -1)], dim=-1)


@dataclass(frozen=True)
class Switch:
    """Window by window one of two priors: ``later`` where ``started``, shape ``(window,)``, else ``first``."""

    started: Bool[Tensor, " window"]
    first: Prior
    later: Prior

    def log_prob(self, z: Float[Tensor, "*draw window parameter"]) -> Float[Tensor, "*draw window"]:
        return torch.where(self.started, self.later.log_prob(z), self.first.log_prob(z))

    def score(self, z: Float[Tensor, "*draw window parameter"]) -> Float[Tensor, "*draw window parameter"]:
        return torch.where(self.started[:, None], self.later.score(z), self.first.score(z))

    def potential_terms(self, windows: int) -> PotentialTerms | None:
        first, later = terms_of(self.first, windows), terms_of(self.later, windows)
        return None if first is None or later is None else later.where(self.started, first)

    @property
    def device(self) -> torch.device | None:
        return getattr(self.first, "device", None)

    def to(self, device: torch.device) -> Switch:
        return Switch(self.started.to(device), prior_on(self.first, device), prior_on(self.later, device))

    def select(self, index: Int[Tensor, " chosen"] | Bool[Tensor, " window"]) -> Prior:
        started = self.started[index]
        first, later = self.first.select(index), self.later.select(index)
        if bool(started.all()):
            return later
        return Switch(started, first, later) if bool(started.any()) else first

    def sample(
        self, count: int, windows: int, *, generator: torch.Generator | None = None
    ) -> Float[Tensor, "count window parameter"]:
        first = self.first.sample(count, windows, generator=generator)
        later = self.later.sample(count, windows, generator=generator)
        return torch.where(self.started[:, None], later, first)

    def center(self) -> Float[Tensor, "window parameter"]:
        return torch.where(self.started[:, None], self.later.center(), self.first.center())


def prior_on(prior: Prior, device: torch.device) -> Prior:
    """The prior on a device; itself where it is there, or where it knows of none."""
    here = getattr(prior, "device", None)
    if here is None or here == device:
        return prior
    return prior.to(device)  # pyright: ignore[reportAttributeAccessIssue]


def _like(x: Tensor) -> dict[str, Any]:
    return {"dtype": torch.float64, "device": x.device}


def default_actuation_prior() -> LogNormalPrior:
    """The first prior of ``(T_L [s], K_L [-])``."""
    return LogNormalPrior(torch.tensor([0.3, 1.0], dtype=torch.float64), torch.tensor([0.7, 0.3], dtype=torch.float64))


def default_jerk_noise_prior() -> HalfNormalPrior:
    """The prior of ``sigma`` [m/s^3] for every window."""
    return HalfNormalPrior(torch.tensor([1.0], dtype=torch.float64))
