r"""Distance of a window's posterior from a baseline posterior, and a test of whether it exceeds chance.

Both are taken as Gaussians in :math:`(\log T_L, \log K_L)`, the scale on which the posteriors are close to normal:

.. math::
    \mathrm{KL}(p\|q) &= \tfrac12 \left[ \mathrm{tr}(Q^{-1}P) + \delta^\top Q^{-1} \delta - d + \log(|Q|/|P|) \right] \\
    H^2(p, q) &= 1 - \frac{|P|^{1/4} |Q|^{1/4}}{|M|^{1/2}} \exp(-\tfrac18 \delta^\top M^{-1} \delta),\ M = (P+Q)/2 \\
    W_2^2(p, q) &= \delta^\top \delta + \mathrm{tr}(P + Q - 2 (Q^{1/2} P Q^{1/2})^{1/2})

Each is increasing in one quadratic form :math:`\delta^\top A \delta` of the distance of the means. If nothing has
changed, :math:`\delta \sim N(0, P + Q)`, as the baseline is uncertain too; the form is then a sum of weighted
chi-squares, whose upper tail in two dimensions is one smooth periodic integral. The threshold on the divergence is that
tail's quantile, so the rate of false alarms is the one requested for any two covariances.
"""

from __future__ import annotations

import math
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from avtorch.errors import InputError

DivergenceKind = Literal["kl", "hellinger", "w2"]
DIVERGENCES: tuple[DivergenceKind, ...] = ("kl", "hellinger", "w2")
_ANGLES = 256


class Gaussian(NamedTuple):
    """A Gaussian belief: `mean` (..., d), `cov` (..., d, d)."""

    mean: Tensor
    cov: Tensor

    @staticmethod
    def of_draws(T_L: Tensor, K_L: Tensor, *, unevenness: tuple[float, float] = (0.0, 0.0)) -> Gaussian:
        """Moments of (log T_L, log K_L) over the last dimension, T_L [s] and K_L [-] of shape (..., draw).

        `unevenness` is the scatter of a sound vehicle's T_L and K_L from window to window, SDs as shares of the value;
        its square is added to the variances.
        """
        if T_L.shape[-1] < 3:
            raise InputError(f"T_L: found {T_L.shape[-1]} draws, need at least 3 for a covariance")
        z = torch.stack([T_L.log(), K_L.log()], dim=-1)
        mean = z.mean(dim=-2)
        centred = z - mean.unsqueeze(-2)
        cov = centred.mT @ centred / (z.shape[-2] - 1)
        # A floor far below any posterior keeps a degenerate cloud (all draws alike) invertible.
        floor = torch.diag(torch.tensor([1e-12 + u * u for u in unevenness], dtype=z.dtype, device=z.device))
        return Gaussian(mean, cov + floor)

    def combine(self, other: Gaussian) -> Gaussian:
        """Combine two independent posteriors of the same parameters (product of the densities)."""
        total = torch.linalg.inv(self.cov + other.cov)
        mean = self.mean + (self.cov @ total @ (other.mean - self.mean).unsqueeze(-1)).squeeze(-1)
        cov = self.cov @ total @ other.cov
        return Gaussian(mean, 0.5 * (cov + cov.mT))


def kl(p: Gaussian, q: Gaussian) -> Tensor:
    """Kullback-Leibler divergence KL(p || q) [nat], shape (...)."""
    inverse = torch.linalg.inv(q.cov)
    trace = (inverse * p.cov.mT).sum(dim=(-2, -1))
    shape = trace - p.mean.shape[-1] + torch.logdet(q.cov) - torch.logdet(p.cov)
    return 0.5 * (shape + _form(p.mean - q.mean, inverse))


def hellinger(p: Gaussian, q: Gaussian) -> Tensor:
    """Hellinger distance in [0, 1], shape (...)."""
    middle = 0.5 * (p.cov + q.cov)
    log_overlap = 0.25 * (torch.logdet(p.cov) + torch.logdet(q.cov)) - 0.5 * torch.logdet(middle)
    exponent = log_overlap - 0.125 * _form(p.mean - q.mean, torch.linalg.inv(middle))
    return torch.sqrt(-torch.expm1(exponent.clamp_max(0.0)))


def w2(p: Gaussian, q: Gaussian) -> Tensor:
    """Wasserstein-2 distance in log units, shape (...)."""
    delta = p.mean - q.mean
    root = _root(q.cov)
    cross = _root(root @ p.cov @ root)
    spread = torch.einsum("...ii->...", p.cov + q.cov - 2.0 * cross)
    return torch.sqrt(((delta * delta).sum(dim=-1) + spread).clamp_min(0.0))


def divergence(kind: DivergenceKind, p: Gaussian, q: Gaussian) -> Tensor:
    """The divergence of the given kind of the window `p` from the baseline `q`, shape (...)."""
    return {"kl": kl, "hellinger": hellinger, "w2": w2}[kind](p, q)


def divergence_p_value(kind: DivergenceKind, p: Gaussian, q: Gaussian) -> Tensor:
    """Probability of a divergence at least this large if nothing has changed, shape (...); two dimensions.

    Alarming below a p-value of `rate` is a threshold on the divergence itself, set so that a share `rate` of in-control
    windows alarms.
    """
    total = p.cov + q.cov
    if kind == "kl":
        form = torch.linalg.inv(q.cov)
    elif kind == "hellinger":
        form = torch.linalg.inv(0.5 * total)
    else:
        form = torch.eye(2, dtype=total.dtype, device=total.device).expand_as(total)
    factor = torch.linalg.cholesky(total)
    weights = torch.linalg.eigvalsh(factor.mT @ form @ factor)
    return weighted_chi2_tail(_form(p.mean - q.mean, form), weights)


def weighted_chi2_tail(value: Tensor, weights: Tensor) -> Tensor:
    """P(w1 X1² + w2 X2² > value) for independent standard normal X, weights (..., 2).

    In polar coordinates the radius integrates out: the mean over angles of exp(-value / (2 (w1 cos² + w2 sin²))); the
    trapezium rule on a smooth periodic function converges geometrically.
    """
    angle = torch.arange(_ANGLES, dtype=weights.dtype, device=weights.device) * (math.pi / _ANGLES)
    scale = weights[..., :1] * angle.cos() ** 2 + weights[..., 1:] * angle.sin() ** 2
    return torch.exp(-0.5 * value.unsqueeze(-1) / scale).mean(dim=-1)


def innovation(window: Gaussian, baseline: Gaussian) -> Tensor:
    """Standardised innovation (..., 2) of a window against the baseline: first log T_L, then log K_L given T_L.

    Whitened by the Cholesky factor of the summed covariances. With a baseline that is the combination of all earlier
    windows these are recursive residuals: in control independent standard normal, over time as well.
    """
    factor = torch.linalg.cholesky(window.cov + baseline.cov)
    delta = (window.mean - baseline.mean).unsqueeze(-1)
    return torch.linalg.solve_triangular(factor, delta, upper=False).squeeze(-1)


def _form(delta: Tensor, matrix: Tensor) -> Tensor:
    return torch.einsum("...i,...ij,...j->...", delta, matrix, delta)


def _root(matrix: Tensor) -> Tensor:
    values, vectors = torch.linalg.eigh(matrix)
    return (vectors * values.clamp_min(0.0).sqrt().unsqueeze(-2)) @ vectors.mT
