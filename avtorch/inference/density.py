"""The interface of a target density: one log density serves SGLD, NUTS and quadrature."""

from __future__ import annotations

from typing import Protocol, TypeGuard, runtime_checkable

import torch
from torch import Tensor

from avtorch.arrays import Bool, Float, Int


@runtime_checkable
class Density(Protocol):
    """A posterior, one per window, in an unconstrained space ``z``: for positive parameters ``z = log(parameter)``.

    The potential of a Langevin sampler is ``U(z) = -log_prob(z)``, on the scale of the *whole* window, never a mean
    over its points.
    """

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters in the order of the last dimension of ``z``."""
        ...

    @property
    def windows(self) -> int:
        """Number of windows, each with a posterior of its own."""
        ...

    def log_prob(self, z: Float[Tensor, "*draw window parameter"]) -> Float[Tensor, "*draw window"]:
        """Log posterior density of ``z`` with shape ``(..., window, parameter)``; returns ``(..., window)``.

        The prior and the Jacobian of ``z`` are included; constants of the likelihood are kept.
        """
        ...

    def initial(self) -> Float[Tensor, "window parameter"]:
        """Where the search for the mode starts, shape ``(window, parameter)``."""
        ...


@runtime_checkable
class SubsampledDensity(Density, Protocol):
    """A density that can also be estimated from a minibatch of its points (SGLD proper)."""

    @property
    def points(self) -> int:
        """Number of points N of a window."""
        ...

    def log_prob_minibatch(
        self, z: Float[Tensor, "*draw window parameter"], index: Int[Tensor, " point"]
    ) -> Float[Tensor, "*draw window"]:
        """Unbiased estimate ``log p(z) + (N/n) sum_i log p(D_i | z)`` over the ``n`` points named by ``index``."""
        ...


@runtime_checkable
class ScoredDensity(Density, Protocol):
    """A density that gives its gradient in closed form, which the sampler then uses instead of autograd."""

    def score(self, z: Float[Tensor, "*draw window parameter"]) -> Float[Tensor, "*draw window parameter"]:
        """Gradient of ``log_prob`` in ``z``, shape ``(..., window, parameter)``."""
        ...


@runtime_checkable
class SelectableDensity(Density, Protocol):
    """A density whose windows can be taken apart, so that a sampler works on those that need it."""

    def select(self, index: Int[Tensor, " chosen"] | Bool[Tensor, " window"]) -> Density:
        """The windows named by ``index``, integers or bool."""
        ...


@runtime_checkable
class ConstrainedDensity(Density, Protocol):
    """A density whose parameters are not all positive, or not ``exp(z)``."""

    def constrain(self, z: Float[Tensor, "*draw parameter"]) -> Float[Tensor, "*draw parameter"]:
        """Parameters in their own units, each from its own entry of ``z``, shape of ``z``."""
        ...


# By one method each: `isinstance` goes through all members of a protocol and takes longer than a step of the sampler.


def has_score(density: Density) -> TypeGuard[ScoredDensity]:
    """Whether it gives its gradient in closed form."""
    return hasattr(density, "score")


def has_selection(density: Density) -> TypeGuard[SelectableDensity]:
    """Whether its windows can be taken apart."""
    return hasattr(density, "select")


def selected(density: Density, index: Int[Tensor, " chosen"]) -> Density:
    """The windows named by ``index``, in order; the density itself where these are all, or cannot be taken apart."""
    return density.select(index) if has_selection(density) and len(index) < density.windows else density


def has_quick_values(density: Density) -> bool:
    """Whether its values cost many times less than its derivatives, which are then better taken from differences."""
    return getattr(density, "quick_values", False)


def constrained(density: Density, z: Float[Tensor, "*draw parameter"]) -> Float[Tensor, "*draw parameter"]:
    """Parameters of ``density`` in their own units: ``exp(z)`` unless it defines another transform."""
    return density.constrain(z) if isinstance(density, ConstrainedDensity) else z.exp()


def score_of(density: Density, z: Float[Tensor, "*draw window d"]) -> Float[Tensor, "*draw window d"]:
    """Gradient of the log density, in closed form where there is one; shape of ``z``."""
    if has_score(density):
        with torch.no_grad():
            return density.score(z)
    z = z.detach().requires_grad_()
    with torch.enable_grad():
        (score,) = torch.autograd.grad(density.log_prob(z).sum(), z)
    return score
