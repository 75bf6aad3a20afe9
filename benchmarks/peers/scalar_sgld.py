"""SGLD as a first version is written: one chain of one window in a Python loop, every row's likelihood by autograd.

Settings:
    whitened: steps along the Laplace covariance at the mode; else one step for all three parameters, as large as the
        steepest direction allows. The mode and its curvature are found by plain Newton steps either way.
    step: ``h`` on a unit Gaussian.
    burn_in, draws: steps; every one is kept.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from benchmarks.peers.contract import Answer, Settings
from benchmarks.peers.problem import LOG_SD, MEDIAN, SIGMA_SCALE, FloatArray, Windows

_MEDIAN = torch.tensor(MEDIAN, dtype=torch.float64)
_LOG_SD = torch.tensor(LOG_SD, dtype=torch.float64)


def log_posterior(z: Tensor, a: Tensor, u: Tensor, jerk: Tensor) -> Tensor:
    """Eq. 4 row by row, prior and Jacobian; ``z``: ``(3,)``."""
    lag, gain, sigma = z.exp()
    likelihood = torch.distributions.Normal((gain * u - a) / lag, sigma, validate_args=False).log_prob(jerk).sum()
    actuation = torch.distributions.Normal(_MEDIAN.log(), _LOG_SD, validate_args=False).log_prob(z[:2]).sum()
    noise = -0.5 * (sigma / SIGMA_SCALE) ** 2 + 0.5 * math.log(2 / math.pi) - math.log(SIGMA_SCALE) + z[2]
    return likelihood + actuation + noise


class Runner:
    def __init__(self, settings: Settings) -> None:
        self.settings = settings

    def log_density(self, windows: Windows, z: FloatArray) -> FloatArray:
        rows = _rows(windows)
        return np.array([float(log_posterior(torch.from_numpy(x), *rows)) for x in z])

    def run(self, windows: Windows, seed: int) -> Answer:
        s, rows = self.settings, _rows(windows)
        g = torch.Generator().manual_seed(seed)
        z, curvature = _mode(rows)
        values, basis = torch.linalg.eigh(curvature)
        scale = basis / values.sqrt() if s["whitened"] else torch.eye(3, dtype=z.dtype) / values.max().sqrt()
        move, spread, root = scale @ scale.T, scale, math.sqrt(s["step"])
        kept = torch.empty(s["draws"], 3, dtype=z.dtype)
        for k in range(s["burn_in"] + s["draws"]):
            z.requires_grad_()
            (gradient,) = torch.autograd.grad(log_posterior(z, *rows), z)
            with torch.no_grad():
                noise = spread @ torch.randn(3, generator=g, dtype=z.dtype)
                z = z + 0.5 * s["step"] * (move @ gradient) + root * noise
            if k >= s["burn_in"]:
                kept[k - s["burn_in"]] = z
        return Answer(kept.exp().numpy()[None, :, None])


def _rows(windows: Windows) -> tuple[Tensor, Tensor, Tensor]:
    return torch.from_numpy(windows.a[0]), torch.from_numpy(windows.u[0]), torch.from_numpy(windows.jerk[0])


def _mode(rows: tuple[Tensor, Tensor, Tensor]) -> tuple[Tensor, Tensor]:
    """Mode ``(3,)`` and Hessian of the potential there, from least squares by damped Newton steps."""
    a, u, jerk = rows
    b, g = torch.linalg.lstsq(torch.stack([-a, u], -1), jerk[:, None]).solution[:, 0]
    residual = (jerk + b * a - g * u).std()
    good = b > 0.05 and g > 0
    z = torch.stack([1 / b, g / b, residual]).log() if good else torch.tensor([*MEDIAN, 0.5], dtype=a.dtype).log()

    def potential(z: Tensor) -> Tensor:
        return -log_posterior(z, *rows)

    damping = 1.0
    for _ in range(60):
        gradient = torch.func.grad(potential)(z)
        values, basis = torch.linalg.eigh(torch.func.hessian(potential)(z))
        step = -basis @ ((basis.T @ gradient) / values.abs())
        if float(-0.5 * step @ gradient) < 1e-8:
            break
        trial = z + damping * step / step.abs().max().clamp_min(1.0)
        better = bool(potential(trial) <= potential(z))
        z, damping = (trial, min(1.0, 2 * damping)) if better else (z, damping / 4)
    return z, torch.func.hessian(potential)(z)
