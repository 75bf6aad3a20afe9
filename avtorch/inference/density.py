r"""The interface of a target density: one log density serves SGLD, NUTS and quadrature.

A density may be of *exponential form*, and a walk over it is then a short compiled loop: its potential's only
transcendental functions are exponentials,

.. math::
    U(z) = U_p(z) + \tfrac12\, e^\top C\, e, \qquad e = \exp(E z)

with ``U_p``, the :class:`PotentialTerms`, the part of prior and Jacobian. Every density here that a window's sums make
is of this form, and every prior of :mod:`avtorch.inference.priors`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, Protocol, TypeGuard, runtime_checkable

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


def has_selection(density: Density) -> TypeGuard[SelectableDensity]:
    """Whether its windows can be taken apart."""
    # `isinstance` goes through all members of a protocol and takes longer than a step of the sampler
    return hasattr(density, "select")


def selected(density: Density, index: Int[Tensor, " chosen"]) -> Density:
    """The windows named by ``index``, in order; the density itself where these are all, or cannot be taken apart."""
    return density.select(index) if has_selection(density) and len(index) < density.windows else density


def constrained(density: Density, z: Float[Tensor, "*draw parameter"]) -> Float[Tensor, "*draw parameter"]:
    """Parameters of ``density`` in their own units: ``exp(z)`` unless it defines another transform."""
    return density.constrain(z) if isinstance(density, ConstrainedDensity) else z.exp()


def score_of(density: Density, z: Float[Tensor, "*draw window d"]) -> Float[Tensor, "*draw window d"]:
    """Gradient of the log density, in closed form where there is one; shape of ``z``."""
    closed = getattr(density, "score", None)
    if closed is not None:
        with torch.no_grad():
            return closed(z)
    z = z.detach().requires_grad_()
    with torch.enable_grad():
        (score,) = torch.autograd.grad(density.log_prob(z).sum(), z)
    return score


def matvec(matrix: Float[Tensor, "*window i j"], x: Float[Tensor, "*draw window j"]) -> Float[Tensor, "*draw window i"]:
    """``matrix @ x`` of every window; the result is in memory window by window, as sums over its draws are quickest."""
    flat = x.reshape(-1, *x.shape[-2:]).permute(1, 2, 0)
    return (matrix @ flat).permute(2, 0, 1).reshape(*x.shape[:-1], matrix.shape[-2])


class PotentialTerms(NamedTuple):
    r"""What is quadratic in ``z``, and in ``e^z`` parameter by parameter; the terms of independent parts are added.

    .. math::
        k + l \cdot z + \tfrac12 (z - m)^\top Q (z - m) + \textstyle\sum_i (a_i e^{z_i} + \tfrac12 s_i e^{2 z_i})
    """

    constant: Float[Tensor, " window"]
    linear: Float[Tensor, "window d"]
    center: Float[Tensor, "window d"]
    quadratic: Float[Tensor, "window d d"]
    own_linear: Float[Tensor, "window d"]
    own_square: Float[Tensor, "window d"]

    @classmethod
    def of(
        cls,
        windows: int,
        d: int,
        *,
        constant: Tensor | float = 0.0,
        linear: Tensor | float = 0.0,
        center: Tensor | float = 0.0,
        quadratic: Tensor | float = 0.0,
        own_linear: Tensor | float = 0.0,
        own_square: Tensor | float = 0.0,
    ) -> PotentialTerms:
        """Each term expanded to all windows, on the device of those that are tensors; those left out are zero."""
        given = (constant, linear, center, quadratic, own_linear, own_square)
        device = next((term.device for term in given if isinstance(term, Tensor)), None)

        def full(value: Tensor | float, *shape: int) -> Tensor:
            # not `as_tensor`, which would wait for a graphics card
            value = value if isinstance(value, Tensor) else torch.full((), value, dtype=torch.float64, device=device)
            return value.to(torch.float64).expand(windows, *shape)

        vectors = full(own_linear, d), full(own_square, d)
        return cls(full(constant), full(linear, d), full(center, d), full(quadratic, d, d), *vectors)

    def beside(self, other: PotentialTerms) -> PotentialTerms:
        """The terms of both, over the parameters of this one and then those of the other."""
        windows, d = self.linear.shape
        whole = d + other.linear.shape[1]
        quadratic = self.linear.new_zeros(windows, whole, whole)
        quadratic[:, :d, :d], quadratic[:, d:, d:] = self.quadratic, other.quadratic
        vectors = ("linear", "center", "own_linear", "own_square")
        joined = {name: torch.cat([getattr(self, name), getattr(other, name)], -1) for name in vectors}
        return PotentialTerms(constant=self.constant + other.constant, quadratic=quadratic, **joined)

    def where(self, chosen: Bool[Tensor, " window"], other: PotentialTerms) -> PotentialTerms:
        """These terms where ``chosen``, else the other's."""
        pairs = zip(self, other, strict=True)
        return PotentialTerms(*(torch.where(chosen.reshape(-1, *[1] * (x.dim() - 1)), x, y) for x, y in pairs))

    def potential(self, z: Float[Tensor, "*draw window d"]) -> Float[Tensor, "*draw window"]:
        """The terms' sum, ``(..., window)``."""
        off, own = z - self.center, z.exp()
        half = 0.5 * off * matvec(self.quadratic, off)
        each = half + self.linear * z + own * (self.own_linear + 0.5 * self.own_square * own)
        return self.constant + each.sum(-1)

    def slope(self, z: Float[Tensor, "*draw window d"]) -> Float[Tensor, "*draw window d"]:
        """Gradient of :meth:`potential`."""
        own, pull = z.exp(), matvec(self.quadratic, z - self.center)
        return pull + self.linear + own * (self.own_linear + self.own_square * own)


@dataclass(frozen=True)
class ExponentialForm:
    """A potential of exponential form in three parameters.

    Attributes:
        terms: of prior and Jacobian.
        exponents: ``E``, ``(3, 3)``.
        coupling: ``C``, symmetric, ``(window, 3, 3)``.
    """

    terms: PotentialTerms
    exponents: Float[Tensor, "3 3"]
    coupling: Float[Tensor, "window 3 3"]

    def potential(self, z: Float[Tensor, "*draw window 3"]) -> Float[Tensor, "*draw window"]:
        """``U(z)``, minus the log density."""
        e = matvec(self.exponents, z).exp()
        pairs = (e * matvec(self.coupling, e)).sum(-1)
        return self.terms.potential(z) + 0.5 * pairs

    def slope(self, z: Float[Tensor, "*draw window 3"]) -> Float[Tensor, "*draw window 3"]:
        """Gradient of :meth:`potential`."""
        e = matvec(self.exponents, z).exp()
        pulled = e * matvec(self.coupling, e)
        return self.terms.slope(z) + matvec(self.exponents.mT, pulled)


def exponential_form(density: Density) -> ExponentialForm | None:
    """Minus its log density in exponential form, where it is of this form."""
    return getattr(density, "exponential_form", None)
