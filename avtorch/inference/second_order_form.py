"""Second-order lags for a stream: the same loop over windows, with a speed or a position command.

The belief is about ``(T_V, K_V)`` or ``(T_P, zeta)``. The monitor's verdicts are about the GLVD's ``(T_L, K_L)`` and
do not apply to it.
"""

from __future__ import annotations

import torch
from torch import Tensor

from avtorch.inference.excitation import ExcitationRule
from avtorch.inference.form import Rows, WindowLikelihood
from avtorch.inference.jerk import JerkStatistics
from avtorch.inference.priors import Prior
from avtorch.inference.sampler_settings import SamplerSettings
from avtorch.inference.second_order import PositionLagDensity, SpeedLagDensity, default_accel_noise_prior


class SpeedLagForm:
    """Windows of ``speed_cmd``, ``speed`` and ``accel``; the rule of excitation is the jerk form's, at its reference.

    Give the stream ``actuation_prior=default_speed_lag_prior()``.

    Example:
        >>> from avtorch.inference import BeliefStream, SpeedLagForm, default_speed_lag_prior
        >>> form = SpeedLagForm()
        >>> stream = BeliefStream(window=2.0, form=form, actuation_prior=default_speed_lag_prior())
        >>> form.columns, form.names
        (('speed_cmd', 'speed', 'accel'), ('T_V', 'K_V', 'sigma'))
    """

    names = SpeedLagDensity.names
    columns = ("speed_cmd", "speed", "accel")
    sampler = SamplerSettings()

    def __init__(self, *, rule: ExcitationRule | None = None, noise_prior: Prior | None = None) -> None:
        self.rule = ExcitationRule() if rule is None else rule
        self.noise_prior: Prior = default_accel_noise_prior() if noise_prior is None else noise_prior

    def likelihood(self, rows: Rows, full: float) -> WindowLikelihood:
        sums = SpeedLagDensity.sums(rows["speed"], rows["speed_cmd"], rows["accel"], rows["usable"]).with_least_noise()
        return WindowLikelihood(
            n=sums.n,
            excited=self.rule(sums, full),
            density=lambda index, prior: SpeedLagDensity(sums.select(index), prior),
        )


class PositionLagForm:
    """Windows of ``position_cmd``, ``position``, ``speed`` and ``accel``.

    A window is excited if least squares alone would resolve ``T_P`` and ``zeta`` to the share ``resolved`` at a lag of
    1 s and critical damping, from the columns and the noise level only. Give the stream
    ``actuation_prior=default_position_lag_prior()``.

    Example:
        >>> from avtorch.inference import BeliefStream, PositionLagForm, default_position_lag_prior
        >>> form = PositionLagForm()
        >>> stream = BeliefStream(window=2.0, form=form, actuation_prior=default_position_lag_prior())
        >>> form.columns, form.names
        (('position_cmd', 'position', 'speed', 'accel'), ('T_P', 'zeta', 'sigma'))
    """

    names = PositionLagDensity.names
    columns = ("position_cmd", "position", "speed", "accel")
    sampler = SamplerSettings()

    def __init__(self, *, resolved: float = 0.2, share: float = 0.5, noise_prior: Prior | None = None) -> None:
        self.resolved, self.share = resolved, share
        self.noise_prior: Prior = default_accel_noise_prior() if noise_prior is None else noise_prior

    def likelihood(self, rows: Rows, full: float) -> WindowLikelihood:
        error = rows["position_cmd"] - rows["position"]
        sums = PositionLagDensity.sums(error, rows["speed"], rows["accel"], rows["usable"]).with_least_noise()
        sd_T, sd_zeta = _predicted_log_sd(sums)
        enough = sums.n >= max(4.0, self.share * full)
        return WindowLikelihood(
            n=sums.n,
            excited=(sd_T <= self.resolved) & (sd_zeta <= self.resolved) & enough,
            density=lambda index, prior: PositionLagDensity(sums.select(index), prior),
        )


def _predicted_log_sd(s: JerkStatistics) -> tuple[Tensor, Tensor]:
    """SDs of ``log T_P`` and ``log zeta`` that least squares predicts at ``T_P`` 1 s and ``zeta`` 1, ``(window,)``.

    There the coefficients ``(2 zeta/T, 1/T²)`` are ``(2, 1)``; ``log T = -log(c_2)/2`` and ``log zeta = log(c_1/2) +
    log T``.
    """
    determinant = s.aa * s.uu - s.au.square()
    solvable = determinant > 1e-12 * s.aa * s.uu
    scale = s.least_squares()[2].square() / torch.where(solvable, determinant, 1.0)
    var_1, var_2, cov = scale * s.uu, scale * s.aa, scale * s.au
    sd_zeta = 0.5 * (var_1 + var_2 - 2 * cov).clamp_min(0.0).sqrt()
    return torch.where(solvable, 0.5 * var_2.sqrt(), torch.inf), torch.where(solvable, sd_zeta, torch.inf)
