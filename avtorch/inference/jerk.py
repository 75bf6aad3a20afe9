"""The jerk form: jerk is measured (paper, Eq. 4), ``jerk_i ~ Normal(-a_i/T_L + K_L u_i/T_L, sigma^2)``.

Which windows of a stream are excited is a fixed rule on ``a``, ``u`` and the noise level, never on the posterior.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import TypeAlias

import torch
from torch import Tensor

from avtorch.arrays import Bool, Float, Int, Real
from avtorch.inference.density import ExponentialForm, PotentialTerms
from avtorch.inference.device import Device
from avtorch.inference.form import Rows, WindowLikelihood
from avtorch.inference.priors import Joint, Prior, default_actuation_prior, default_jerk_noise_prior
from avtorch.inference.sampler_settings import SamplerSettings
from avtorch.vehicle.arguments import Batch, Signal
from avtorch.vehicle.glvd import glvd_jerk

WindowRows: TypeAlias = Real[Tensor, "window time"]

_LOG_2PI = math.log(2 * math.pi)

# log of (1, 1/T, K/T) / sigma from log(T, K, sigma)
_LOG_SCALED = torch.tensor([[0.0, 0.0, -1.0], [-1.0, 0.0, -1.0], [-1.0, 1.0, -1.0]], dtype=torch.float64)

RESOLUTION = 1e-4
"""Finest noise that the sums resolve, as a share of the RMS jerk: the log density of a window, about ``n`` jerks
squared over noise squared, then keeps eight digits, enough for Newton's method to find the mode."""


def jerk_log_likelihood(
    T_L: Batch, K_L: Batch, sigma: Batch, a: Signal, u: Signal, jerk: Signal
) -> Float[Tensor, "*batch"]:
    """Log likelihood of a window of measured jerk (Eq. 4 with Eq. 1), differentiable in every argument.

    `T_L`, `K_L`, `sigma`: lag [s], gain [-], jerk noise [m/s^3]; shape ``(...)``. `a`, `u`, `jerk`: realised and
    demanded acceleration [m/s^2], jerk [m/s^3]; shape ``(..., time)``.

    Returns:
        Sum over time, shape ``(...)``.
    """
    residual = jerk - glvd_jerk(a, u, T_L.unsqueeze(-1), K_L.unsqueeze(-1))
    return -0.5 * (residual / sigma.unsqueeze(-1)).square().sum(-1) - jerk.shape[-1] * (sigma.log() + 0.5 * _LOG_2PI)


@dataclass(frozen=True)
class JerkStatistics:
    """Six sums over a window and its number of points: all that Eq. 4 needs, so its cost does not grow with the points.

    Every field has shape ``(window,)``; ``aj`` is the sum of ``a * jerk`` and so on.
    """

    n: Float[Tensor, " window"]
    jj: Float[Tensor, " window"]
    aj: Float[Tensor, " window"]
    uj: Float[Tensor, " window"]
    aa: Float[Tensor, " window"]
    au: Float[Tensor, " window"]
    uu: Float[Tensor, " window"]

    @classmethod
    def from_samples(
        cls, a: WindowRows, u: WindowRows, jerk: WindowRows, mask: Bool[Tensor, "window time"] | None = None
    ) -> JerkStatistics:
        """Sums over the last dimension of ``a, u, jerk``, each ``(window, time)``, where ``mask`` is true."""
        a, u, jerk = (torch.as_tensor(x, dtype=torch.float64) for x in (a, u, jerk))
        weight = torch.ones_like(a) if mask is None else mask.to(a)
        # a masked row may hold anything, also NaN
        a, u, jerk = (torch.where(weight > 0, x, 0.0) for x in (a, u, jerk))
        pairs = ((jerk, jerk), (a, jerk), (u, jerk), (a, a), (a, u), (u, u))
        return cls(weight.sum(-1), *((x * y).sum(-1) for x, y in pairs))

    def select(self, index: Int[Tensor, " chosen"] | Bool[Tensor, " window"]) -> JerkStatistics:
        """The windows named by ``index``."""
        return JerkStatistics(*(getattr(self, f.name)[index] for f in fields(self)))

    def to(self, device: Device) -> JerkStatistics:
        """The same sums on another device, where the density made of them then works."""
        return JerkStatistics(*(getattr(self, f.name).to(device) for f in fields(self)))

    def with_least_noise(self, share: float = RESOLUTION) -> JerkStatistics:
        """The same sums with white noise of ``share`` of the RMS jerk mixed in, where the residual holds less.

        For a simulated log without noise the residual is round-off, and sigma would have no lower bound.
        """
        lacking = (share**2 * self.jj - self.n * self.least_squares()[2].square()).clamp_min(0.0)
        return replace(self, jj=self.jj + lacking)

    def least_squares(self) -> tuple[Float[Tensor, " window"], Float[Tensor, " window"], Float[Tensor, " window"]]:
        """Least squares of jerk on ``(-a, u)``: estimates of ``1/T_L`` and ``K_L/T_L`` and the residual's SD [m/s^3].

        Where ``a`` and ``u`` are collinear (or constant zero) the estimates are NaN; the SD is then that of the jerk.
        """
        determinant = self.aa * self.uu - self.au.square()
        # collinear to round-off: the determinant has lost all its digits
        solvable = determinant > 1e-12 * self.aa * self.uu
        safe = torch.where(solvable, determinant, 1.0)
        inverse_lag = torch.where(solvable, (-self.aj * self.uu + self.au * self.uj) / safe, torch.nan)
        gain_over_lag = torch.where(solvable, (self.aa * self.uj - self.au * self.aj) / safe, torch.nan)
        fitted = torch.where(solvable, -inverse_lag * self.aj + gain_over_lag * self.uj, 0.0)
        freedom = (self.n - 2 * solvable).clamp_min(1.0)
        return inverse_lag, gain_over_lag, ((self.jj - fitted).clamp_min(0.0) / freedom).sqrt()


class JerkDensity:
    """Posterior of ``(T_L [s], K_L [-], sigma [m/s^3])`` of every window, from the six sums and a prior.

    It is the log density of :func:`jerk_log_likelihood` plus the prior, written in the sums. Eq. 1 is a regression of
    jerk on ``(a, u)``: half the residual sum of squares is a quadratic form in ``(1, 1/T_L, K_L/T_L) / sigma``.
    """

    names = ("T_L", "K_L", "sigma")

    def __init__(self, statistics: JerkStatistics, prior: Prior | None = None) -> None:
        self.statistics = s = statistics
        own = Joint(default_actuation_prior(), default_jerk_noise_prior()) if prior is None else prior
        self.prior = own.to(s.n.device)
        rows = ((s.jj, s.aj, -s.uj), (s.aj, s.aa, -s.au), (-s.uj, -s.au, s.uu))
        coupling = torch.stack([torch.stack(row, -1) for row in rows], -2)
        none = torch.zeros_like(s.n)
        noise = PotentialTerms.of(len(s.n), 3, constant=0.5 * _LOG_2PI * s.n, linear=torch.stack([none, none, s.n], -1))
        self._likelihood = ExponentialForm(noise, _LOG_SCALED.to(s.n.device), coupling)

    @property
    def windows(self) -> int:
        return self.statistics.n.shape[0]

    def select(self, index: Int[Tensor, " chosen"] | Bool[Tensor, " window"]) -> JerkDensity:
        """The windows named by ``index``."""
        return JerkDensity(self.statistics.select(index), self.prior.select(index))

    @cached_property
    def exponential_form(self) -> ExponentialForm:
        """Minus :meth:`log_prob`."""
        prior, noise = self.prior.terms(self.windows), self._likelihood.terms
        terms = prior._replace(constant=prior.constant + noise.constant, linear=prior.linear + noise.linear)
        return replace(self._likelihood, terms=terms)

    def log_likelihood(self, z: Float[Tensor, "*draw window 3"]) -> Float[Tensor, "*draw window"]:
        """Eq. 4 from the sums; ``z = log(T_L, K_L, sigma)``, ``(..., window, 3)``; returns ``(..., window)``."""
        return -self._likelihood.potential(z)

    def log_prob(self, z: Float[Tensor, "*draw window 3"]) -> Float[Tensor, "*draw window"]:
        return -self.exponential_form.potential(z)

    def score(self, z: Float[Tensor, "*draw window 3"]) -> Float[Tensor, "*draw window 3"]:
        """Gradient of :meth:`log_prob` in ``z``, in closed form."""
        return -self.exponential_form.slope(z)

    def initial(self) -> Float[Tensor, "window 3"]:
        """Least squares where it gives positive values near the plausible range, else the prior's centre."""
        inverse_lag, gain_over_lag, residual_sd = self.statistics.least_squares()
        center = self.prior.center().expand(self.windows, 3)
        T, K = 1 / inverse_lag, gain_over_lag / inverse_lag
        plausible = (T > 0.01) & (T < 20) & (K > 0.02) & (K < 20)
        T = torch.where(plausible, T, center[:, 0].exp())
        K = torch.where(plausible, K, center[:, 1].exp())
        return torch.stack([T, K, residual_sd.clamp(1e-6, 1e6)], -1).log()


class JerkPoints(JerkDensity):
    """The same density kept point by point, so that a minibatch of it can be drawn (SGLD proper).

    Example:
        >>> import torch
        >>> from avtorch.inference import JerkPoints, SamplerSettings, sample
        >>> a, u, noise = torch.randn(3, 1, 500, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
        >>> points = JerkPoints(a, u, (0.9 * u - a) / 0.5 + 0.1 * noise)
        >>> minibatches = SamplerSettings(chains=64, batch=100, step=0.2, burn_in=50, compare=False)
        >>> posterior = sample(points, minibatches, generator=torch.Generator().manual_seed(0))
        >>> [round(x, 1) for x in posterior.mean[0].tolist()]  # T_L [s], K_L [-], sigma [m/s³]
        [0.5, 0.9, 0.1]
    """

    def __init__(self, a: WindowRows, u: WindowRows, jerk: WindowRows, prior: Prior | None = None) -> None:
        """``a, u, jerk``: shape ``(window, time)``, units as in :func:`jerk_log_likelihood`."""
        super().__init__(JerkStatistics.from_samples(a, u, jerk), prior)
        self._columns = torch.stack([jerk, a, u], -1).to(torch.float64)

    @property
    def points(self) -> int:
        return self._columns.shape[1]

    def select(self, index: Int[Tensor, " chosen"] | Bool[Tensor, " window"]) -> JerkPoints:
        """The windows named by ``index``."""
        jerk, a, u = self._columns[index].unbind(-1)
        return JerkPoints(a, u, jerk, self.prior.select(index))

    def log_prob_minibatch(
        self, z: Float[Tensor, "*draw window 3"], index: Int[Tensor, " point"]
    ) -> Float[Tensor, "*draw window"]:
        jerk, a, u = self._columns[:, index].unbind(-1)
        T, K, sigma = z.exp().unbind(-1)
        return self.prior.log_prob(z) + self.points / len(index) * jerk_log_likelihood(T, K, sigma, a, u, jerk)


@dataclass(frozen=True)
class ExcitationRule:
    """A window is excited if it alone would resolve the accepted change at a fixed reference vehicle.

    Least squares of jerk on ``(-a, u)`` predicts the standard deviations of ``1/T_L`` and ``K_L/T_L`` from the products
    of ``a`` and ``u`` and the noise level; at the reference they become those of ``T_L`` and ``K_L``. A window whose
    prediction is wider hardly changes the prior and would only dilute the belief. The rule does not depend on the
    vehicle: for one much quicker than the reference (a lag of 0.05 s, say) it excludes some windows that would resolve
    it.

    `T_ref`, `K_ref`: reference lag [s] and gain [-], slow enough that a degraded vehicle is resolved, too. `sd_T`,
    `sd_K`: the widest predicted SDs of ``T_L`` [s] and ``K_L`` [-]: the paper's accepted changes. `share`: the least
    share of the window's rows that must be usable.
    """

    T_ref: float = 1.0
    K_ref: float = 1.0
    sd_T: float = 0.2
    sd_K: float = 0.15
    share: float = 0.5

    def predicted_sd(self, statistics: JerkStatistics) -> tuple[Float[Tensor, " window"], Float[Tensor, " window"]]:
        """Predicted SDs of ``T_L`` [s] and ``K_L`` [-] at the reference vehicle, each ``(window,)``.

        Infinite where ``a`` and ``u`` are constant zero or collinear.
        """
        s = statistics
        _, _, noise = s.least_squares()
        determinant = s.aa * s.uu - s.au.square()
        solvable = determinant > 1e-12 * s.aa * s.uu
        inverse = noise.square() / torch.where(solvable, determinant, 1.0)
        var_inverse_lag, var_gain, cov = inverse * s.uu, inverse * s.aa, inverse * s.au
        # delta method: T = 1/x, K = y/x with x = 1/T_L, y = K_L/T_L
        sd_T = self.T_ref**2 * var_inverse_lag.sqrt()
        var_K = self.T_ref**2 * (var_gain - 2 * self.K_ref * cov + self.K_ref**2 * var_inverse_lag)
        sd_K = var_K.clamp_min(0.0).sqrt()
        return torch.where(solvable, sd_T, torch.inf), torch.where(solvable, sd_K, torch.inf)

    def __call__(self, statistics: JerkStatistics, rows: float) -> Bool[Tensor, " window"]:
        """Excited or not, ``(window,)`` bool; ``rows`` is how many rows a full window has."""
        sd_T, sd_K = self.predicted_sd(statistics)
        return (sd_T <= self.sd_T) & (sd_K <= self.sd_K) & (statistics.n >= max(4.0, self.share * rows))


class JerkForm:
    """Jerk is measured: Eq. 4 of the paper from six sums."""

    names = ("T_L", "K_L", "sigma")
    columns = ("accel_cmd", "accel", "jerk")
    sampler = SamplerSettings()

    def __init__(self, *, rule: ExcitationRule | None = None, noise_prior: Prior | None = None) -> None:
        self.rule = ExcitationRule() if rule is None else rule
        self.noise_prior = default_jerk_noise_prior() if noise_prior is None else noise_prior

    def likelihood(self, rows: Rows, full: float) -> WindowLikelihood:
        statistics = JerkStatistics.from_samples(rows["accel"], rows["accel_cmd"], rows["jerk"], rows["usable"])
        statistics = statistics.with_least_noise()
        return WindowLikelihood(
            n=statistics.n,
            excited=self.rule(statistics, full),
            density=lambda index, prior: JerkDensity(statistics.select(index), prior),
        )
