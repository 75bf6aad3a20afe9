r"""A quick density near the exact one, and the exact one with gradients from it that are corrected at random steps.

The response is nearly linear in the coordinates, so quadratics in them are fitted to a hundred responses. Products of
residuals in each band, and with them the whole likelihood, are then polynomials whose coefficients form one small Gram
matrix a band, whatever the length of the drive.

SGLD still targets the exact density: the surrogate is the control variate of its gradient. At one random step in
`points` the difference to the exact gradient is added, times `points`. That is unbiased everywhere, with little noise
where the surrogate is accurate; far from the mode the exact gradient is taken (Baker et al. 2019, for control variates
of SGLD).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import cast

import numpy as np
import torch
from torch import Tensor

from avtorch.arrays import FloatArray
from avtorch.gap.engine.coordinates import INDEX
from avtorch.gap.engine.density import HypothesisDensity, WithScore, of_products, pairs
from avtorch.gap.engine.evidence import log_prior
from avtorch.gap.engine.free_forms import band_products


@dataclass(frozen=True, eq=False)
class Surrogate:
    """`log_prob` of a `density` from quadratics in w, `x = centre + scale w`; `gram` (term, band, pair, term).

    `middle` (coordinate,), `spread` (coordinate, coordinate), a triangular root: of the fitted draws in z."""

    density: HypothesisDensity
    centre: Tensor
    scale: Tensor
    gram: Tensor = field(repr=False)
    middle: Tensor
    spread: Tensor

    windows = 1

    @classmethod
    def of(cls, density: HypothesisDensity, x: FloatArray) -> Surrogate:
        """Fitted by least squares to responses at draws `x` (draw, coordinate) of roughly the posterior."""
        h, data = density.hypothesis, density.hypothesis.data
        draws = torch.as_tensor(x)
        centre, scale, z = draws.mean(0), _root(draws), density.unconstrain(draws)
        terms = _terms(torch.linalg.solve_triangular(scale, (draws - centre).mT, upper=False).mT)
        weight = torch.linalg.pinv(terms).numpy()
        values, at = h.values.copy(), [INDEX[n] for n in density.names]
        columns = np.zeros((len(weight), *data.measured.shape))
        for k, own in enumerate(x):
            values[at] = own
            columns += np.multiply.outer(weight[:, k], data.measured - h.response(values))
        products = band_products(data, columns)
        each = np.stack([products[:, i, j] for i, j in pairs(data)], 1)  # band, pair, term, term
        gram = np.ascontiguousarray(np.moveaxis(0.5 * (each + each.swapaxes(-1, -2)), -2, 0))
        return cls(density, centre, scale, torch.as_tensor(gram), z.mean(0), _root(z))

    @property
    def names(self) -> tuple[str, ...]:
        return self.density.names

    def initial(self) -> Tensor:
        return self.density.unconstrain(self.centre)[None]

    def constrain(self, z: Tensor) -> Tensor:
        return self.density.constrain(z)

    def distance(self, z: Tensor) -> Tensor:
        """Of `z` (..., coordinate) from the middle of the fitted draws, in their standard deviations: (...)."""
        away = (z - self.middle).unsqueeze(-1)
        return torch.linalg.solve_triangular(self.spread, away, upper=False).squeeze(-1).norm(dim=-1)

    def log_prob(self, z: Tensor) -> Tensor:
        """Log density (..., 1) of `z` (..., 1, coordinate). Differentiable once."""
        return cast(Tensor, WithScore.apply(z, self))

    def value(self, z: Tensor) -> Tensor:
        """`log_prob` without a graph."""
        return self.expand(z)[0]

    def score(self, z: Tensor) -> Tensor:
        """Gradient of `log_prob`, the shape of `z`."""
        return self.expand(z)[1]

    def expand(self, z: Tensor) -> tuple[Tensor, Tensor]:
        """Log density (..., 1) and its gradient (..., 1, coordinate): products once, and their derivative from them."""
        density, h = self.density, self.density.hypothesis
        with torch.enable_grad():
            z = z.detach().requires_grad_()
            x = density.constrain(z)
            away = (x - self.centre).unsqueeze(-1)
            terms = _terms(torch.linalg.solve_triangular(self.scale, away, upper=False).squeeze(-1))
            rest = log_prior(h, density.names, x) + density.log_slope(z).sum(-1)
            half = torch.tensordot(terms.detach(), self.gram, dims=1)  # (..., band, pair, term)
            products = (half @ terms.detach()[..., None, :, None]).squeeze(-1).requires_grad_()
            likelihood = density.temper * of_products(h.data, products.mT)
            (slope,) = torch.autograd.grad(likelihood.sum(), products)
            of_terms = 2 * (slope[..., None] * half).sum((-3, -2))
            (score,) = torch.autograd.grad((terms * of_terms).sum() + rest.sum(), z)
        return (likelihood + rest).detach(), score


def _root(draws: Tensor) -> Tensor:
    """A triangular root of the covariance of `draws` (draw, coordinate), also where many are the same."""
    covariance = draws.T.cov().reshape(draws.shape[1], -1)
    return torch.linalg.cholesky(
        covariance + 1e-6 * torch.diag(covariance.diagonal()) + 1e-24 * torch.eye(len(covariance))
    )


def terms_of(count: int) -> int:
    """Number of terms of a quadratic in so many coordinates."""
    return 1 + count + count * (count + 1) // 2


def _terms(w: Tensor) -> Tensor:
    first, second = torch.combinations(torch.arange(w.shape[-1]), with_replacement=True).T
    return torch.cat([torch.ones_like(w[..., :1]), w, w[..., first] * w[..., second]], -1)


@dataclass(frozen=True, eq=False)
class Corrected:
    """The `exact` density with minibatch estimates from the `surrogate`, corrected at one step in `points`.

    All chains are corrected at the same step, as one call for many is cheap. `reach`: the surrogate's `distance` up to
    which its gradients are used.
    """

    exact: HypothesisDensity
    surrogate: Surrogate
    points: int
    reach: float

    windows = 1

    @property
    def names(self) -> tuple[str, ...]:
        return self.exact.names

    def initial(self) -> Tensor:
        return self.exact.initial()

    def constrain(self, z: Tensor) -> Tensor:
        return self.exact.constrain(z)

    def approximation(self) -> Surrogate:
        return self.surrogate

    def log_prob(self, z: Tensor) -> Tensor:
        return self.exact.log_prob(z)

    def score(self, z: Tensor) -> Tensor:
        return self.exact.score(z)

    def log_prob_minibatch(self, z: Tensor, index: Tensor) -> Tensor:
        """Log density of `z` (..., 1, coordinate), its gradient unbiased over uniform `index` in 0 ... points - 1."""
        flat = z.reshape(-1, z.shape[-1])
        far = ~(self.surrogate.distance(flat.detach()) <= self.reach)  # NaN counts as far
        share = torch.where(far, 1.0, float((index == 0).sum()) * self.points / len(index))
        value = torch.where(far, 0.0, self.surrogate.log_prob(flat))
        chosen = share.nonzero().squeeze(-1)
        if not len(chosen):
            return value.reshape(z.shape[:-1])
        apart = self.exact.log_prob(flat[chosen][:, None])[:, 0] - value[chosen]
        return value.index_add(0, chosen, share[chosen] * apart).reshape(z.shape[:-1])
