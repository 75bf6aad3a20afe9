"""Conjugate regression and importance resampling: independent draws, the limit for this likelihood.

Eq. 4 is a linear regression of jerk on ``(-a, u)`` with coefficients ``(1/T_L, K_L/T_L)``, whose conjugate posterior is
normal-inverse-gamma: independent draws in closed form. Importance weights bring them from the conjugate prior to any
other. It needs no Markov chain and no step size, and exists for this likelihood only.

Settings: draws and proposals of `sample_conjugate`. The effective draws counted are the lesser of what the weights
leave and of what ArviZ finds in the resampled draws.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from avtorch.errors import InputError
from avtorch.inference import JerkDensity, Posterior
from avtorch.inference.device import check_generator
from benchmarks.peers.contract import Answer
from benchmarks.peers.own import OwnDensity, density_of
from benchmarks.peers.problem import Windows

#: Variance of the conjugate prior over that of the intended prior: the proposal must have the wider tails.
WIDENING = 4.0
#: Draws of the prior that its moments in ``(1/T_L, K_L/T_L)`` are taken from.
MOMENT_DRAWS = 2048


@dataclass(frozen=True)
class Conjugate:
    """Draws resampled by their importance weights, and how good the weights were.

    Attributes:
        posterior: ``(1, draw, window, 3)`` draws of ``(T_L [s], K_L [-], sigma [m/s^3])``, equally weighted; its
            ``converged`` is false where the effective sample size is below the least asked for.
        ess: effective sample size of the weighted proposals, ``(window,)``. Resampling adds nothing to it.

    Example:
        >>> import torch
        >>> from avtorch.validation import synthetic_windows
        >>> from benchmarks.peers.conjugate import sample_conjugate
        >>> found = sample_conjugate(synthetic_windows(3, seed=1).density, draws=1000)
        >>> tuple(found.posterior.draws.shape), bool((found.ess > 400).all())
        ((1, 1000, 3, 3), True)
    """

    posterior: Posterior
    ess: Tensor


def sample_conjugate(
    density: JerkDensity,
    *,
    draws: int = 4000,
    proposals: int | None = None,
    least_ess: float = 400.0,
    generator: torch.Generator | None = None,
) -> Conjugate:
    """Sample every window's posterior by conjugate regression and importance resampling.

    The conjugate prior is ``N(m, sigma^2 V)`` on ``(1/T_L, K_L/T_L)`` with the moments of the density's own prior,
    widened, and flat in ``log sigma``. Weights are the density over the proposal, so any prior is represented exactly;
    a window where least squares gives a negative lag only loses the proposals outside the quadrant.

    Args:
        density: the jerk posterior with any prior.
        draws: draws returned a window.
        proposals: independent proposals a window; twice the draws by default.
        least_ess: below this many effective proposals a window is flagged.

    Raises:
        InputError: for ``draws`` or ``proposals`` below 2.

    Example:
        >>> import torch
        >>> from avtorch.inference import integrate
        >>> from avtorch.validation import synthetic_windows
        >>> from benchmarks.peers.conjugate import sample_conjugate
        >>> density = synthetic_windows(1, seed=1).density
        >>> found = sample_conjugate(density, generator=torch.Generator().manual_seed(0)).posterior
        >>> exact = integrate(density, nodes=25)
        >>> bool(((found.mean - exact.mean).abs() < 0.1 * exact.sd).all())
        True
    """
    proposals = 2 * draws if proposals is None else proposals
    for name, value in (("draws", draws), ("proposals", proposals)):
        if value < 2:
            raise InputError(f"{name}: {value} is less than 2")
    check_generator(generator, density.statistics.n.device)
    proposal = _NormalInverseGamma.of(density, generator)
    coefficients, variance = proposal.sample(proposals, generator)
    inside = (coefficients > 0).all(-1)
    b, g = torch.where(inside.unsqueeze(-1), coefficients, 1.0).unbind(-1)
    z = torch.stack([-b.log(), (g / b).log(), 0.5 * variance.log()], -1)
    # from (1/T, K/T, sigma^2) to z: the Jacobian is (1/T)(K/T) 2 sigma^2
    log_q = proposal.log_prob(coefficients, variance) + (b * g * 2 * variance).log()
    with torch.no_grad():
        log_weight = torch.where(inside, density.log_prob(z) - log_q, -torch.inf)
    peak = log_weight.amax(0)
    peak = torch.where(peak.isfinite(), peak, 0.0)  # nothing inside: all weights are zero
    weight = (log_weight - peak).exp().nan_to_num(nan=0.0)
    total = weight.sum(0)
    ess = total.square() / weight.square().sum(0).clamp_min(torch.finfo(weight.dtype).tiny)
    index = _systematic(weight, draws, generator)
    chosen = z.take_along_dim(index.unsqueeze(-1), 0).exp()
    posterior = Posterior(density.names, chosen.unsqueeze(0), ess >= least_ess)
    return Conjugate(posterior, ess)


def _systematic(weight: Tensor, count: int, generator: torch.Generator | None) -> Tensor:
    """Indices ``(count, window)`` into ``weight`` ``(proposal, window)``: evenly spaced in the cumulated weight."""
    cumulated = weight.cumsum(0).T.contiguous()
    offset = torch.rand(len(cumulated), 1, generator=generator, dtype=weight.dtype, device=weight.device)
    at = (torch.arange(count, dtype=weight.dtype, device=weight.device) + offset) / count * cumulated[:, -1:]
    return torch.searchsorted(cumulated, at, right=True).clamp_max(len(weight) - 1).T


@dataclass(frozen=True)
class _NormalInverseGamma:
    """``sigma^2 ~ InverseGamma(shape, rate)``, ``beta ~ N(center, sigma^2 precision^-1)``, one a window."""

    center: Tensor
    precision: Tensor
    shape: Tensor
    rate: Tensor

    @classmethod
    def of(cls, density: JerkDensity, generator: torch.Generator | None) -> _NormalInverseGamma:
        s = density.statistics
        log_T, log_K, _ = density.prior.sample(MOMENT_DRAWS, density.windows, generator=generator).unbind(-1)
        beta = torch.stack([-log_T, log_K - log_T], -1).exp()
        prior_mean = beta.mean(0)
        centred = beta - prior_mean
        prior_cov = torch.einsum("nwi,nwj->wij", centred, centred) / (len(beta) - 1)
        residual = s.least_squares()[2].square().clamp_min(1e-12)
        pull = torch.linalg.inv(WIDENING * prior_cov) * residual[:, None, None]
        gram = torch.stack([torch.stack([s.aa, -s.au], -1), torch.stack([-s.au, s.uu], -1)], -2)
        moment = torch.stack([-s.aj, s.uj], -1) + torch.einsum("wij,wj->wi", pull, prior_mean)
        precision = gram + pull
        center = torch.linalg.solve(precision, moment)
        off = center - prior_mean
        squares = (
            s.jj
            - 2 * (center * torch.stack([-s.aj, s.uj], -1)).sum(-1)
            + torch.einsum("wi,wij,wj->w", center, gram, center)
            + torch.einsum("wi,wij,wj->w", off, pull, off)
        )
        # a residual of pure round-off, or a window of a row or none, still needs a proper proposal
        rate = 0.5 * torch.maximum(squares, 1e-12 * s.jj).clamp_min(1e-12)
        return cls(center, precision, 0.5 * s.n.clamp_min(2.0), rate)

    def sample(self, count: int, generator: torch.Generator | None) -> tuple[Tensor, Tensor]:
        """Coefficients ``(count, window, 2)`` and variances ``(count, window)``."""
        # the public Gamma distribution takes no generator; this is the routine it calls
        gamma = torch._standard_gamma(self.shape.expand(count, -1).contiguous(), generator=generator)  # pyright: ignore[reportPrivateImportUsage]
        variance = self.rate / gamma
        like: dict[str, Any] = {"dtype": self.center.dtype, "device": self.center.device}
        noise = torch.randn(count, *self.center.shape, generator=generator, **like)
        lower = torch.linalg.cholesky(self.precision)
        spread = torch.linalg.solve_triangular(lower.mT, noise.permute(1, 2, 0), upper=True).permute(2, 0, 1)
        return self.center + variance.sqrt().unsqueeze(-1) * spread, variance

    def log_prob(self, beta: Tensor, variance: Tensor) -> Tensor:
        """Log density of coefficients and variance, ``(count, window)``."""
        off = beta - self.center
        distance = (torch.einsum("wij,nwj->nwi", self.precision, off) * off).sum(-1) / variance
        normal = -0.5 * distance + 0.5 * torch.linalg.slogdet(self.precision)[1] - (2 * math.pi * variance).log()
        inverse_gamma = self.shape * self.rate.log() - self.shape.lgamma() - (self.shape + 1) * variance.log()
        return normal + inverse_gamma - self.rate / variance


class Runner(OwnDensity):
    def run(self, windows: Windows, seed: int) -> Answer:
        generator = torch.Generator().manual_seed(seed)
        found = sample_conjugate(density_of(windows), generator=generator, **self.settings)
        return Answer(found.posterior.draws.numpy(), ess=found.ess.numpy())
