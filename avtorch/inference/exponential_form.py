r"""Potentials whose only transcendental functions are exponentials: a walk over them is a short compiled loop.

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

from avtorch.arrays import Bool, Float
from avtorch.inference.density import Density


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
    """A potential of the module's form in three parameters.

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


@runtime_checkable
class ExponentialDensity(Density, Protocol):
    """A density of the module's form, so that its walk can be compiled."""

    @property
    def exponential_form(self) -> ExponentialForm:
        """Minus its log density."""
        ...


def has_form(density: Density) -> TypeGuard[ExponentialDensity]:
    """Whether it is an :class:`ExponentialDensity`."""
    return hasattr(density, "exponential_form")
