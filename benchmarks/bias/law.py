"""The stationary spread of an arm in closed form, for posteriors that are nearly Gaussian.

Near the mode the walk is linear, ``w' = (I - hP/2) w + noise`` of covariance ``h I + h^2/4 S`` with ``P`` the precision
and ``S`` the covariance of the gradient's noise, so its stationary covariance solves a discrete Lyapunov equation. In
whitened coordinates that is ``Var = (1 + h s^2/4) / (1 - h/4)`` with independent and ``1 + (h s^2/4) / (1 - h/4)`` with
averaged noise. With control variates ``S`` is itself proportional to ``Var``.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from avtorch.inference.coordinates import Coordinates
from benchmarks.bias.control_variates import gradients_by_point
from benchmarks.bias.windows import Problem

#: Laplace draws over which the noise that control variates leave is averaged.
PLACES = 16


def point_covariance(problem: Problem, *, control_variates: bool, seed: int = 0) -> Tensor:
    """Covariance over points of the gradient of the log density estimated from one point alone, ``(window, d, d)``.

    A minibatch of ``b`` points, drawn with replacement, has a ``b``-th of it. With control variates it is the
    covariance of the remaining noise, averaged over the Laplace approximation.
    """
    density, mode = problem.density, problem.mode
    at_mode = gradients_by_point(density, mode.z)
    if not control_variates:
        return _covariance(at_mode)
    g = torch.Generator().manual_seed(seed)
    total = torch.zeros_like(mode.scale)
    for _ in range(PLACES):
        normal = torch.randn(mode.z.shape, generator=g, dtype=mode.z.dtype)
        # antithetic, so that the mean over points lies at the mode
        for sign in (1.0, -1.0):
            z = mode.z + sign * torch.einsum("wij,wj->wi", mode.scale, normal)
            total += _covariance(gradients_by_point(density, z) - at_mode) / (2 * PLACES)
    return total


def _covariance(gradients: Tensor) -> Tensor:
    centred = gradients - gradients.mean(1, keepdim=True)
    return torch.einsum("wni,wnj->wij", centred, centred) / gradients.shape[1]


def sd_ratio(
    problem: Problem, coordinates: Coordinates, h: float, covariance: Tensor | None, *, averaged: bool, grows: bool
) -> Tensor:
    """Predicted SD over the Laplace approximation's, ``(window, d)``; infinite where the step is unstable.

    Args:
        coordinates: where the walk takes its step ``h``, each window's own pace counted.
        covariance: of the gradient's noise in ``z``, ``(window, d, d)``, or None for full gradients.
        averaged: the noise is that of Leimkuhler and Matthews.
        grows: ``covariance`` is that at the Laplace approximation and grows with the walk's own (control variates).
    """
    lower = coordinates.lower
    hessian = torch.linalg.inv(problem.mode.covariance)
    p, basis = torch.linalg.eigh(lower.mT @ hessian @ lower)
    to_z = lower @ basis
    noise = torch.zeros_like(hessian) if covariance is None else to_z.mT @ covariance @ to_z
    keep = 1 - h * p / 2
    left = 1 - keep[:, :, None] * keep[:, None, :]
    base = torch.diag_embed(1 / p if averaged else 1 / (p * (1 - h * p / 4)))
    added = h**2 / 4 * noise / left
    spread = base + added
    if grows:
        for _ in range(100):
            # the walk's covariance over the Laplace approximation's, mean over directions
            size = (spread.diagonal(dim1=-2, dim2=-1) * p).mean(-1).clamp_max(1e6)
            spread = base + size[:, None, None] * added
        spread = torch.where((size < 1e3)[:, None, None], spread, math.inf)
    unstable = (h * p >= 4).any(-1)[:, None]
    variance = torch.einsum("wij,wjk,wik->wi", to_z, spread.nan_to_num(posinf=1e30), to_z)
    ratio = (variance / problem.mode.covariance.diagonal(dim1=-2, dim2=-1)).sqrt()
    return torch.where(unstable | (ratio > 1e3), math.inf, ratio)
