"""Which windows are excited: a fixed rule on ``a``, ``u`` and the noise level, never on the posterior."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from avtorch.arrays import Bool, Float
from avtorch.inference.jerk import JerkStatistics


@dataclass(frozen=True)
class ExcitationRule:
    """A window is excited if it alone would resolve the accepted change at a fixed reference vehicle.

    Least squares of jerk on ``(-a, u)`` predicts the standard deviations of ``1/T_L`` and ``K_L/T_L`` from the products
    of ``a`` and ``u`` and the noise level; at the reference they become those of ``T_L`` and ``K_L``. A window whose
    prediction is wider hardly changes the prior and would only dilute the belief. The rule does not depend on the
    vehicle: for one much quicker than the reference (a lag of 0.05 s, say) it excludes some windows that would resolve
    it.

    Attributes:
        T_ref, K_ref: reference lag [s] and gain [-], slow enough that a degraded vehicle is resolved, too.
        sd_T, sd_K: the widest predicted SDs of ``T_L`` [s] and ``K_L`` [-]: the paper's accepted changes.
        share: the least share of the window's rows that must be usable.

    Example:
        >>> import torch
        >>> from avtorch.inference import ExcitationRule, JerkStatistics
        >>> t = torch.linspace(0.0, 2.0, 200, dtype=torch.float64)
        >>> u = torch.stack([torch.sin(3 * t), 0.01 * torch.sin(3 * t)])  # a lively window and a calm one
        >>> noise = 0.1 * torch.randn(200, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
        >>> sums = JerkStatistics.from_samples(0.8 * u.roll(30, -1), u, 2 * u - 1.6 * u.roll(30, -1) + noise)
        >>> ExcitationRule()(sums, rows=200).tolist()
        [True, False]
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
