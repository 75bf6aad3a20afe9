r"""Recursive least squares of measured jerk on ``(-a, u)``, with a forgetting factor.

Eq. 1 of the paper is linear in :math:`\beta = (1/T_L, K_L/T_L)`. In information form, row by row,

.. math::
    R \leftarrow \lambda R + x x^\top, \qquad r \leftarrow \lambda r + x\,\dot a, \qquad \hat\beta = R^{-1} r,

with ``x = (-a, u)``: the textbook recursion, started without any prior. As the sums are linear in the rows, a window is
added at once. The covariance is the customary :math:`\hat\sigma^2 R^{-1}`, which treats older rows as noisier. Where
nothing has changed it is too wide, by :math:`\sqrt 2` in SD once the memory is full.
"""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any

import torch
from torch import Tensor

from avtorch.errors import InputError
from avtorch.inference.belief import Z90, Summary
from avtorch.inference.estimator import WindowedEstimator
from avtorch.inference.form import Form, Rows
from avtorch.inference.jerk import JerkStatistics

CLEAR = 4.0
"""SDs that both coefficients must be above zero: nearer to zero ``1/x`` has no useful interval, and no mean."""

_SUMS = tuple(f.name for f in fields(JerkStatistics))


class RecursiveLeastSquares(WindowedEstimator):
    """Least squares over all excited rows so far, a row that is ``k`` rows old weighted by ``forgetting**k``.

    There is no prior, so a belief needs both coefficients well above zero (``CLEAR``); until then a window counts as
    not converged: its sums are kept, the belief is carried over.

    `forgetting`: in (0, 1], per row; 1 forgets nothing. The memory is ``1 / (1 - forgetting)`` rows: the default
    remembers 200, a window of 2 s at 100 Hz.

    Raises `InputError` where jerk is not measured, or for ``forgetting`` out of range.
    """

    def __init__(self, form: Form, *, forgetting: float = 0.995, **options: Any) -> None:
        if "jerk" not in form.columns:
            raise InputError(
                "estimator: 'rls' needs measured jerk, noisy acceleration would bias it; try 'ekf' or 'map'"
            )
        if not 0 < forgetting <= 1:
            raise InputError(f"forgetting: {forgetting} is not in (0, 1]")
        super().__init__(form, **options)
        self.forgetting = forgetting
        self._memory = {name: torch.zeros(self.vehicles, dtype=torch.float64, device=self.device) for name in _SUMS}

    def _learn(self, rows: Rows, index: Tensor) -> tuple[Summary, Tensor]:
        usable = rows["usable"]
        later = usable.flip(-1).cumsum(-1).flip(-1) - usable.long()  # usable rows behind each row
        root = usable * self.forgetting ** (0.5 * later)
        # a masked row may hold anything, also NaN
        a, u, jerk = (torch.where(usable, rows[name], 0.0) * root for name in ("accel", "accel_cmd", "jerk"))
        new = replace(JerkStatistics.from_samples(a, u, jerk), n=root.square().sum(-1))
        old = self.forgetting ** usable.sum(-1)
        self._remember(index, **{name: old * self._memory[name][index] + getattr(new, name) for name in _SUMS})
        return self._summary(JerkStatistics(**{name: self._memory[name][index] for name in _SUMS}))

    def _summary(self, s: JerkStatistics) -> tuple[Summary, Tensor]:
        s = s.with_least_noise()
        b, g, sigma = s.least_squares()
        scale = sigma.square() / (s.aa * s.uu - s.au.square())
        bb, gg, bg = scale * s.uu, scale * s.aa, scale * s.au
        converged = (b > CLEAR * bb.sqrt()) & (g > CLEAR * gg.sqrt()) & (s.n > 4)
        # the others are not used; any finite numbers will do
        b, g, sigma = (torch.where(converged, x, 1.0) for x in (b, g, sigma))
        bb, gg, bg = (torch.where(converged, x, 0.0) for x in (bb, gg, bg))
        T, K, sd_b = 1 / b, g / b, bb.sqrt()
        sd_K = (gg - 2 * K * bg + K.square() * bb).clamp_min(0.0).sqrt() / b
        K05, K95 = _fieller(b, g, bb, gg, bg)
        spread = (2 * s.n.clamp_min(1.0)).rsqrt()  # of log sigma
        return Summary(
            mean=torch.stack([T, K, sigma], -1),
            sd=torch.stack([sd_b * T.square(), sd_K, sigma * spread], -1),
            q05=torch.stack([1 / (b + Z90 * sd_b), K05, sigma * (-Z90 * spread).exp()], -1),
            q95=torch.stack([1 / (b - Z90 * sd_b), K95, sigma * (Z90 * spread).exp()], -1),
            draws=self._draws(b, g, sigma, sd_b, gg, bg, spread),
        ), converged

    def _draws(
        self, b: Tensor, g: Tensor, sigma: Tensor, sd_b: Tensor, gg: Tensor, bg: Tensor, spread: Tensor
    ) -> Tensor:
        """``(draw, vehicle, 3)`` from the normal of the coefficients, which lies well above zero."""
        noise = torch.randn(3, self.kept, len(b), generator=self.generator, dtype=b.dtype, device=b.device)
        slope = torch.where(sd_b > 0, bg / sd_b.clamp_min(1e-300), 0.0)
        one = b + sd_b * noise[0]
        two = g + slope * noise[0] + (gg - slope.square()).clamp_min(0.0).sqrt() * noise[1]
        # one draw in 30 000 would be beyond CLEAR SDs
        one, two = torch.maximum(one, 1e-3 * b), torch.maximum(two, 1e-3 * g)
        return torch.stack([1 / one, two / one, sigma * (spread * noise[2]).exp()], -1)


def _fieller(b: Tensor, g: Tensor, bb: Tensor, gg: Tensor, bg: Tensor) -> tuple[Tensor, Tensor]:
    """The 90 % interval of ``g / b`` of two correlated normals (Fieller 1954), bounded as ``b`` is well above zero."""
    square = b.square() - Z90**2 * bb
    half = g * b - Z90**2 * bg
    root = (half.square() - square * (g.square() - Z90**2 * gg)).clamp_min(0.0).sqrt()
    return (half - root) / square, (half + root) / square
