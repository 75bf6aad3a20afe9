"""A surrogate of the exact density, of negligible cost: whitened errors as quadratics of the coordinates.

Near the mode whitened errors are almost linear in `z`. Quadratics are fitted to a few dozen rollouts; their sum of
squares is a polynomial whose coefficients form one small Gram matrix, whatever the length of the drive. The sampler
still targets the exact density, with the surrogate as control variate of its gradient: each chain uses the surrogate's
gradient and, at one random step in `points`, adds `points` times the difference to the exact one. This is unbiased
everywhere, and has little noise where the surrogate is accurate. Far from the mode the exact gradient is used.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import combinations

import numpy as np
import torch
from torch import Tensor

from avtorch.gap.posterior.density import RolloutDensity
from avtorch.inference.map import Mode

_REACH = 1.3  # distance from the centre, in posterior standard deviations, at which the quadratics are fitted


@dataclass(frozen=True, eq=False)
class Surrogate:
    """`log_prob` as in `RolloutDensity`, from quadratics around `centre` (coordinate,) in units of `scale`.

    `gram` (term, term): of the whitened errors' terms 1, w, w²/2, w w'. `match` (axis, term): the road grade's, where
    there is one, with its `shrinkage` (size, axis) and `prior` (size,).
    """

    names: tuple[str, ...]
    centre: Tensor
    scale: Tensor
    constant: float
    gram: Tensor = field(repr=False)
    match: Tensor | None = field(default=None, repr=False)
    shrinkage: Tensor | None = field(default=None, repr=False)
    prior: Tensor | None = field(default=None, repr=False)

    windows = 1

    @classmethod
    def of(cls, density: RolloutDensity, centre: Tensor, scale: Tensor) -> Surrogate:
        """Fitted to rollouts at `centre`, along and between the columns of `scale` (a covariance's root)."""
        size = len(centre)
        axes = _REACH * torch.eye(size, dtype=centre.dtype)
        pairs = list(combinations(range(size), 2))
        both = torch.stack([axes[i] + axes[j] for i, j in pairs])
        w = torch.cat([torch.zeros(1, size, dtype=centre.dtype), axes, -axes, both])
        e = density.images(centre + w @ scale.mT)
        at, ahead, behind, mixed = e[0], e[1 : size + 1], e[size + 1 : 2 * size + 1], e[2 * size + 1 :]
        terms = [at[None], (ahead - behind) / (2 * _REACH), (ahead + behind - 2 * at) / _REACH**2]
        first, second = ([p[k] for p in pairs] for k in (0, 1))
        terms.append((mixed - ahead[first] - ahead[second] + at) / _REACH**2)
        columns = np.concatenate(terms)
        parts: dict[str, Tensor] = {}
        slope = density.slope
        if slope is not None:
            found = {"match": slope.image @ columns.T, "shrinkage": slope.shrinkage, "prior": slope.prior}
            parts = {name: torch.as_tensor(value) for name, value in found.items()}
        gram = torch.as_tensor(columns @ columns.T)
        return cls(density.names, centre, scale, density.constant, gram, **parts)

    def initial(self) -> Tensor:
        return self.centre[None]

    def log_prob(self, z: Tensor) -> Tensor:
        """Log density (..., 1) of `z` (..., 1, coordinate)."""
        terms = self._terms(z)
        value = self.constant - 0.5 * (terms * (terms @ self.gram)).sum(-1) - 0.5 * z.square().sum(-1)
        if self.match is None:
            return value
        assert self.shrinkage is not None
        assert self.prior is not None
        match = terms @ self.match.mT
        return value + torch.logsumexp(self.prior + 0.5 * match.square() @ self.shrinkage.mT, -1)

    def _terms(self, z: Tensor) -> Tensor:
        w = torch.linalg.solve_triangular(self.scale, (z - self.centre).unsqueeze(-1), upper=False).squeeze(-1)
        first, second = torch.combinations(torch.arange(w.shape[-1])).T
        return torch.cat([torch.ones_like(w[..., :1]), w, 0.5 * w.square(), w[..., first] * w[..., second]], -1)

    def score(self, z: Tensor) -> Tensor:
        """Gradient of `log_prob`, the shape of `z`."""
        with torch.enable_grad():
            z = z.detach().requires_grad_()
            return torch.autograd.grad(self.log_prob(z).sum(), z)[0]


@dataclass(frozen=True, eq=False)
class Corrected:
    """The exact density, with minibatch estimates from the surrogate that are corrected at random steps.

    At one step in `points` all chains are corrected, by `points` times the difference: one call for many chains is
    cheap.
    """

    exact: RolloutDensity
    surrogate: Surrogate
    mode: Mode
    points: int

    windows = 1

    @property
    def names(self) -> tuple[str, ...]:
        return self.exact.names

    def initial(self) -> Tensor:
        return self.exact.initial()

    def constrain(self, z: Tensor) -> Tensor:
        return self.exact.constrain(z)

    def log_prob(self, z: Tensor) -> Tensor:
        return self.exact.log_prob(z)

    def score(self, z: Tensor) -> Tensor:
        return self.exact.score(z)

    def log_prob_minibatch(self, z: Tensor, index: Tensor) -> Tensor:
        """Log density of `z` (..., 1, coordinate), its gradient unbiased over uniform `index` in 0 ... points - 1."""
        flat = z.reshape(-1, z.shape[-1])
        far = ~self.trusted(flat.detach())  # NaN counts as far
        share = torch.where(far, 1.0, float((index == 0).sum()) * self.points / len(index))
        chosen = share.nonzero().squeeze(-1)
        value = self.surrogate.log_prob(flat)
        value = torch.where(far, 0.0, value)
        if not len(chosen):
            return value.reshape(z.shape[:-1])
        apart = self.exact.log_prob(flat[chosen][:, None])[:, 0] - value[chosen]
        return value.index_add(0, chosen, share[chosen] * apart).reshape(z.shape[:-1])

    def trusted(self, z: Tensor) -> Tensor:
        """Whether the surrogate's gradient may be used at `z` (chain, coordinate)."""
        w = torch.linalg.solve_triangular(self.mode.scale[0], (z - self.mode.z[0])[..., None], upper=False)[..., 0]
        return w.square().sum(-1) <= trusted_square(z.shape[-1])


def trusted_square(size: int) -> float:
    """Squared distance from the mode [posterior standard deviations] up to which a surrogate is used."""
    return size + 4 * (2 * size) ** 0.5
