"""Posteriors of second-order lags, in speed and in location, from measured acceleration: six sums, as for Eq. 4.

One derivative below the GLVD the measured one is the acceleration, which every car has; no jerk is needed. Speed or
location are taken as exact beside it, as the acceleration is in Eq. 4. Both lags are linear in two coefficients of two
columns, so that the sums of :class:`~avtorch.inference.jerk.JerkStatistics` are sufficient statistics of a window.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from avtorch.arrays import Bool, Float, Int, Real
from avtorch.inference.exponential_form import ExponentialForm
from avtorch.inference.jerk import JerkDensity, JerkStatistics
from avtorch.inference.planes import as_planes
from avtorch.inference.priors import HalfNormalPrior, Joint, LogNormalPrior, Prior


def _log_normal(median: tuple[float, float], log_sd: tuple[float, float]) -> LogNormalPrior:
    return LogNormalPrior(torch.tensor(median, dtype=torch.float64), torch.tensor(log_sd, dtype=torch.float64))


def default_speed_lag_prior() -> LogNormalPrior:
    """Of ``(T_V [s], K_V [-])``; 90 % of the lags lie in 0.16 to 1.6 s, around the delays recorded on cars on sale.

    Example:
        >>> from avtorch.inference import default_speed_lag_prior
        >>> default_speed_lag_prior().median.tolist()
        [0.5, 1.0]
    """
    return _log_normal((0.5, 1.0), (0.7, 0.3))


def default_position_lag_prior() -> LogNormalPrior:
    """Of ``(T_P [s], zeta [-])``; around critical damping, with overshoot not excluded.

    Example:
        >>> from avtorch.inference import default_position_lag_prior
        >>> default_position_lag_prior().median.tolist()
        [0.7, 1.0]
    """
    return _log_normal((0.7, 1.0), (0.7, 0.5))


def default_accel_noise_prior() -> HalfNormalPrior:
    """Of ``sigma`` [m/s²], the noise on the acceleration."""
    return HalfNormalPrior(torch.tensor([1.0], dtype=torch.float64))


class SpeedLagDensity(JerkDensity):
    """Posterior of ``(T_V [s], K_V [-], sigma [m/s²])``: ``accel ~ Normal((K_V v_cmd - v)/T_V, sigma^2)``.

    It is Eq. 4 with speed, speed command and acceleration in the places of acceleration, command and jerk.

    Example:
        >>> import torch
        >>> from avtorch.inference import SpeedLagDensity, find_mode
        >>> g = torch.Generator().manual_seed(0)
        >>> v, v_cmd, noise = torch.randn(3, 1, 500, dtype=torch.float64, generator=g)
        >>> sums = SpeedLagDensity.sums(v, v_cmd, (0.9 * v_cmd - v) / 0.8 + 0.1 * noise)
        >>> [round(x, 1) for x in find_mode(SpeedLagDensity(sums)).z.exp()[0].tolist()]  # T_V [s], K_V [-], sigma
        [0.8, 0.9, 0.1]
    """

    names = ("T_V", "K_V", "sigma")

    def __init__(self, statistics: JerkStatistics, prior: Prior | None = None) -> None:
        """``statistics`` by :meth:`sums`."""
        default = Joint(default_speed_lag_prior(), default_accel_noise_prior())
        super().__init__(statistics, default if prior is None else prior)

    @staticmethod
    def sums(
        v: Real[Tensor, "window time"],
        v_cmd: Real[Tensor, "window time"],
        accel: Real[Tensor, "window time"],
        mask: Real[Tensor, "window time"] | Bool[Tensor, "window time"] | None = None,
    ) -> JerkStatistics:
        """Of speed and speed command [m/s] and acceleration [m/s²], each ``(window, time)``."""
        return JerkStatistics.from_samples(v, v_cmd, accel, mask)

    def select(self, index: Int[Tensor, " chosen"] | Bool[Tensor, " window"]) -> SpeedLagDensity:
        """The windows named by ``index``."""
        return SpeedLagDensity(self.statistics.select(index), self.prior.select(index))


class PositionLagDensity(JerkDensity):
    """Posterior of ``(T_P [s], zeta [-], sigma [m/s²])``: ``accel ~ Normal(error/T_P² - 2 zeta v/T_P, sigma^2)``.

    Example:
        >>> import torch
        >>> from avtorch.inference import PositionLagDensity, find_mode
        >>> g = torch.Generator().manual_seed(0)
        >>> error, v, noise = torch.randn(3, 1, 500, dtype=torch.float64, generator=g)
        >>> sums = PositionLagDensity.sums(error, v, error / 0.5**2 - 2 * 0.7 / 0.5 * v + 0.1 * noise)
        >>> [round(x, 1) for x in find_mode(PositionLagDensity(sums)).z.exp()[0].tolist()]  # T_P [s], zeta [-], sigma
        [0.5, 0.7, 0.1]
    """

    names = ("T_P", "zeta", "sigma")

    def __init__(self, statistics: JerkStatistics, prior: Prior | None = None) -> None:
        """``statistics`` by :meth:`sums`."""
        default = Joint(default_position_lag_prior(), default_accel_noise_prior())
        super().__init__(statistics, default if prior is None else prior)

    @staticmethod
    def sums(
        error: Real[Tensor, "window time"],
        v: Real[Tensor, "window time"],
        accel: Real[Tensor, "window time"],
        mask: Real[Tensor, "window time"] | Bool[Tensor, "window time"] | None = None,
    ) -> JerkStatistics:
        """Of ``x_cmd - x`` [m], speed [m/s] and acceleration [m/s²], each ``(window, time)``."""
        return JerkStatistics.from_samples(v, error, accel, mask)

    def select(self, index: Int[Tensor, " chosen"] | Bool[Tensor, " window"]) -> PositionLagDensity:
        """The windows named by ``index``."""
        return PositionLagDensity(self.statistics.select(index), self.prior.select(index))

    @staticmethod
    def _scaled_coefficients(z: Tensor) -> Tensor:
        """``(1, 2 zeta/T, 1/T^2) / sigma``."""
        log_T, log_zeta, log_sigma = z.unbind(-1)
        return torch.stack([-log_sigma, math.log(2) + log_zeta - log_T - log_sigma, -2 * log_T - log_sigma], -1).exp()

    def exponential_form(self) -> ExponentialForm | None:
        """Minus :meth:`log_prob` in the form that a compiled walk takes; ``None`` for a prior that is not of it."""
        exponents = torch.tensor([[0.0, 0.0, -1.0], [-1.0, 1.0, -1.0], [-2.0, 0.0, -1.0]], dtype=torch.float64)
        return self._form_with(exponents, torch.tensor([0.0, math.log(2), 0.0], dtype=torch.float64))

    def score(self, z: Float[Tensor, "*draw window 3"]) -> Float[Tensor, "*draw window 3"]:
        """Gradient of :meth:`log_prob` in ``z``, in closed form."""
        scaled = self._scaled_coefficients(z)
        # by the logarithms of the three coefficients; the form is half the chi2
        one, damped, pulled = (-2 * torch.einsum("wij,...wj->...wi", self._half_form, scaled) * scaled).unbind(-1)
        by_sigma = -(one + damped + pulled) - self.statistics.n
        return as_planes(-damped - 2 * pulled, damped, by_sigma).add_(self.prior.score(z))

    def initial(self) -> Float[Tensor, "window 3"]:
        """Least squares where it gives positive coefficients in a plausible range, else the prior's centre."""
        damped, pulled, residual_sd = self.statistics.least_squares()
        center = self.prior.center().expand(self.windows, 3)
        T = pulled.rsqrt()
        zeta = 0.5 * damped * T
        plausible = (T > 0.01) & (T < 20) & (zeta > 0.02) & (zeta < 20)
        T, zeta = torch.where(plausible, T, center[:, 0].exp()), torch.where(plausible, zeta, center[:, 1].exp())
        return torch.stack([T, zeta, residual_sd.clamp(1e-6, 1e6)], -1).log()
