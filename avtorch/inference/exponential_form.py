r"""Potentials whose only transcendental functions are exponentials: a walk over them is a short compiled loop.

.. math::
    U(z) = U_p(z) + \tfrac12\, e^\top C\, e, \qquad e = \exp(E z + c)

with ``U_p``, the :class:`PotentialTerms`, the part of prior and Jacobian. Every density here that a window's sums make
is of this form, with every prior of :mod:`avtorch.inference.priors`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol, TypeGuard, runtime_checkable

import torch
from torch import Tensor

from avtorch.arrays import Bool, Float
from avtorch.inference.density import Density


@dataclass(frozen=True)
class PotentialTerms:
    r"""What is quadratic in ``z``, and in ``e^z`` parameter by parameter; the terms of independent parts are added.

    .. math::
        k + l \cdot z + \tfrac12 z^\top Q z + \textstyle\sum_i (a_i e^{z_i} + \tfrac12 s_i e^{2 z_i})
    """

    constant: Float[Tensor, " window"]
    linear: Float[Tensor, "window d"]
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
        quadratic: Tensor | float = 0.0,
        own_linear: Tensor | float = 0.0,
        own_square: Tensor | float = 0.0,
    ) -> PotentialTerms:
        """Each term expanded to all windows, on the device of those that are tensors; those left out are zero."""
        given = (constant, linear, quadratic, own_linear, own_square)
        device = next((term.device for term in given if isinstance(term, Tensor)), None)

        def full(value: Tensor | float, *shape: int) -> Tensor:
            # not `as_tensor`, which would wait for a graphics card
            value = value if isinstance(value, Tensor) else torch.full((), value, dtype=torch.float64, device=device)
            return value.to(torch.float64).expand(windows, *shape)

        vectors = full(own_linear, d), full(own_square, d)
        return cls(full(constant), full(linear, d), full(quadratic, d, d), *vectors)

    def beside(self, other: PotentialTerms) -> PotentialTerms:
        """The terms of both, over the parameters of this one and then those of the other."""
        windows, d, rest = len(self.constant), self.linear.shape[1], other.linear.shape[1]
        quadratic = self.linear.new_zeros(windows, d + rest, d + rest)
        quadratic[:, :d, :d], quadratic[:, d:, d:] = self.quadratic, other.quadratic
        pairs = ((self.linear, other.linear), (self.own_linear, other.own_linear), (self.own_square, other.own_square))
        linear, own_linear, own_square = (torch.cat(pair, -1) for pair in pairs)
        return PotentialTerms(self.constant + other.constant, linear, quadratic, own_linear, own_square)

    def where(self, chosen: Bool[Tensor, " window"], other: PotentialTerms) -> PotentialTerms:
        """These terms where ``chosen``, else the other's."""

        def pick(mine: Tensor, theirs: Tensor) -> Tensor:
            return torch.where(chosen.reshape(-1, *[1] * (mine.dim() - 1)), mine, theirs)

        names = ("constant", "linear", "quadratic", "own_linear", "own_square")
        return PotentialTerms(*(pick(getattr(self, name), getattr(other, name)) for name in names))


@dataclass(frozen=True)
class ExponentialForm:
    """A potential of the module's form in three parameters.

    Attributes:
        terms: of prior and Jacobian.
        exponents: ``E``, ``(3, 3)``.
        offsets: ``c``, ``(3,)``.
        coupling: ``C``, symmetric, ``(window, 3, 3)``.
    """

    terms: PotentialTerms
    exponents: Float[Tensor, "3 3"]
    offsets: Float[Tensor, "3"]
    coupling: Float[Tensor, "window 3 3"]

    def potential(self, z: Float[Tensor, "*draw window 3"]) -> Float[Tensor, "*draw window"]:
        """``U(z)``, minus the log density."""
        t, e, own = self.terms, (z @ self.exponents.T + self.offsets).exp(), z.exp()
        square = torch.einsum("...wi,wij,...wj->...w", z, t.quadratic, z)
        pairs = torch.einsum("...wi,wij,...wj->...w", e, self.coupling, e)
        return (
            t.constant
            + (t.linear * z + t.own_linear * own + 0.5 * t.own_square * own**2).sum(-1)
            + (0.5 * (square + pairs))
        )


@runtime_checkable
class ExponentialDensity(Density, Protocol):
    """A density that is of the module's form, so that its walk can be compiled."""

    def exponential_form(self) -> ExponentialForm | None:
        """Minus its log density; ``None`` where its prior is not of this form."""
        ...


def has_form(density: Density) -> TypeGuard[ExponentialDensity]:
    """Whether it is an :class:`ExponentialDensity`."""
    return hasattr(density, "exponential_form")


def terms_of(prior: Any, windows: int) -> PotentialTerms | None:
    """Those of a prior, or ``None`` where it has none, or where a subclass has another density than its parent."""
    if not hasattr(prior, "potential_terms") or outdated(prior, "potential_terms"):
        return None
    return prior.potential_terms(windows)


def outdated(thing: object, form: str) -> bool:
    """Whether a subclass overrides the density or its gradient, but not the method ``form`` that also defines it."""
    classes = type(thing).__mro__

    def depth(name: str) -> int:
        return next((i for i, each in enumerate(classes) if name in vars(each)), len(classes))

    return min(depth("log_prob"), depth("score"), depth("log_likelihood")) < depth(form)
