"""A stand-in for the exact density that costs nothing: white errors as quadratics of the coordinates.

Near the mode white errors are all but linear in `z`. Fitted by quadratics from a few dozen rollouts, their sum of
squares is a polynomial whose coefficients are one small Gram matrix, however long the drive. The sampler walks on the
exact density all the same: the stand-in is the control variate of its gradient. Each chain's gradient is the
stand-in's plus, at a random one step in `points`, `points` times what the exact one has more: unbiased wherever a chain
is, and with hardly any noise where the stand-in is good. Where a chain is far out it is the exact gradient itself.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import combinations

import numpy as np
import torch
from torch import Tensor

from avtorch.gap.posterior.density import RolloutDensity
from avtorch.inference.map import Mode

_REACH = 1.3  # posterior standard deviations from the centre at which the quadratics are fitted


@dataclass(frozen=True, eq=False)
class Surrogate:
    """`log_prob` as `RolloutDensity` has it, by quadratics about `centre` (coordinate,) in units of `scale`.

    `gram` (term, term): of the white errors' terms 1, w, w²/2, w w'. `match` (axis, term): the slope's, where there is
    one, with its `shrinkage` (size, axis) and `prior` (size,).
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
        """Fitted to rollouts at `centre`, along the columns of `scale` (a root of a covariance), and between them."""
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
        """Of `z` (..., 1, coordinate): (..., 1)."""
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
    """The exact density, whose minibatch estimates are the surrogate's, set right at random steps.

    At one step in `points` all chains are set right, `points` times as much: one call for many chains is cheap.
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
        """Of `z` (..., 1, coordinate), the gradient unbiased over uniform `index` in 0 ... points - 1."""
        flat = z.reshape(-1, z.shape[-1])
        far = ~self.trusted(flat.detach())  # NaN is far, too
        share = torch.where(far, 1.0, float((index == 0).sum()) * self.points / len(index))
        chosen = share.nonzero().squeeze(-1)
        value = self.surrogate.log_prob(flat)
        value = torch.where(far, 0.0, value)
        if not len(chosen):
            return value.reshape(z.shape[:-1])
        apart = self.exact.log_prob(flat[chosen][:, None])[:, 0] - value[chosen]
        return value.index_add(0, chosen, share[chosen] * apart).reshape(z.shape[:-1])

    def trusted(self, z: Tensor) -> Tensor:
        """Whether the surrogate's gradient may stand in at `z` (chain, coordinate)."""
        w = torch.linalg.solve_triangular(self.mode.scale[0], (z - self.mode.z[0])[..., None], upper=False)[..., 0]
        return w.square().sum(-1) <= trusted_square(z.shape[-1])


def trusted_square(size: int) -> float:
    """Square of the distance from the mode [posterior standard deviations] up to which a surrogate is trusted."""
    return size + 4 * (2 * size) ** 0.5
