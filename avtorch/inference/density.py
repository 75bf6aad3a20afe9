"""What a target density must offer: one log density serves SGLD, NUTS and quadrature alike."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

from torch import Tensor


@runtime_checkable
class Density(Protocol):
    """A posterior, one per window, in an unconstrained space ``z``: for positive parameters ``z = log(parameter)``.

    The potential of a Langevin sampler is ``U(z) = -log_prob(z)``, on the scale of the *whole* window: no mean over the
    points is taken anywhere.
    """

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters in the order of the last dimension of ``z``."""
        ...

    @property
    def windows(self) -> int:
        """Number of windows, each with a posterior of its own."""
        ...

    def log_prob(self, z: Tensor) -> Tensor:
        """Log posterior density of ``z`` with shape ``(..., window, parameter)``; returns ``(..., window)``.

        The prior and the Jacobian of ``z`` are counted; constants of the likelihood are kept.
        """
        ...

    def initial(self) -> Tensor:
        """Where the search for the mode starts, shape ``(window, parameter)``."""
        ...


@runtime_checkable
class SubsampledDensity(Density, Protocol):
    """A density that can also be estimated from a minibatch of its points (SGLD proper)."""

    @property
    def points(self) -> int:
        """Number of points N of a window."""
        ...

    def log_prob_minibatch(self, z: Tensor, index: Tensor) -> Tensor:
        """Unbiased estimate ``log p(z) + (N/n) sum_i log p(D_i | z)`` over the ``n`` points named by ``index``."""
        ...


@runtime_checkable
class ScoredDensity(Density, Protocol):
    """A density that gives its gradient in closed form, which the sampler then uses instead of autograd."""

    def score(self, z: Tensor) -> Tensor:
        """Gradient of ``log_prob`` in ``z``, shape ``(..., window, parameter)``."""
        ...


@runtime_checkable
class SelectableDensity(Density, Protocol):
    """A density whose windows can be taken apart, so that a sampler works on those that need it."""

    def select(self, index: Tensor) -> Density:
        """The windows named by ``index``, integers or bool."""
        ...


@runtime_checkable
class ConstrainedDensity(Density, Protocol):
    """A density whose parameters are not all positive, or not ``exp(z)``."""

    def constrain(self, z: Tensor) -> Tensor:
        """Parameters in their own units, each from its own entry of ``z``, shape of ``z``."""
        ...


def constrained(density: Density, z: Tensor) -> Tensor:
    """Parameters of ``density`` in their own units: ``exp(z)`` unless it says otherwise."""
    return density.constrain(z) if isinstance(density, ConstrainedDensity) else z.exp()
