"""What a target density must offer: one log density serves SGLD, NUTS and quadrature alike."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

from torch import Tensor


@runtime_checkable
class Density(Protocol):
    """A posterior over positive parameters, one per window, in the unconstrained space ``z = log(parameter)``.

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

        The prior and the Jacobian of ``z = log(parameter)`` are counted; constants of the likelihood are kept.
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
