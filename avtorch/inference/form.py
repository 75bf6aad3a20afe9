"""A form of the log density, and the likelihood that it gives of a window of rows.

Which windows are excited is a fixed rule on ``a``, ``u`` and the noise level, never on the posterior.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from avtorch.arrays import Bool, Float, Real
from avtorch.inference.density import Density
from avtorch.inference.jerk import JerkDensity, JerkStatistics
from avtorch.inference.priors import Prior, default_jerk_noise_prior
from avtorch.inference.sampler_settings import SamplerSettings

Rows = Mapping[str, Tensor]
"""One window: ``time`` ``(time,)`` [s] and ``usable`` and the measured columns, each ``(vehicle, time)``."""


@dataclass(frozen=True)
class WindowLikelihood:
    """The likelihood of one window of every vehicle: with a prior it gives a posterior density.

    `n`: usable rows, ``(vehicle,)``. `excited`: ``(vehicle,)`` bool, by the fixed rule. `density`: the posterior
    density of the vehicles named by an index, from their priors.
    """

    n: Real[Tensor, " vehicle"]
    excited: Bool[Tensor, " vehicle"]
    density: Callable[[Tensor, Prior], Density]


class Form(Protocol):
    """A form of the log density: its columns, its parameters, and the likelihood of a window of rows."""

    @property
    def names(self) -> tuple[str, ...]: ...

    @property
    def columns(self) -> tuple[str, ...]: ...

    @property
    def noise_prior(self) -> Prior: ...

    @property
    def sampler(self) -> SamplerSettings:
        """Default settings of the sampler for its posteriors."""
        ...

    def likelihood(self, rows: Rows, full: float) -> WindowLikelihood:
        """The likelihood of a window; ``full`` is the number of rows of a complete one."""
        ...


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
