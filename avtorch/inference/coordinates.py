"""Coordinates in which one step length suits every window: whitened at the mode, slower where a posterior is skewed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from avtorch.arrays import Float
from avtorch.inference.density import Density, matvec, score_of
from avtorch.inference.map import Mode

Whitening = Literal["full", "diagonal", "none"]


@dataclass(frozen=True)
class Coordinates:
    """``z = mode + lower @ w``.

    `mode`: ``(window, d)``. `lower`: lower triangular, ``(window, d, d)``.
    """

    mode: Float[Tensor, "window d"]
    lower: Float[Tensor, "window d d"]

    @classmethod
    def of(cls, mode: Mode, whitening: Whitening = "full") -> Coordinates:
        """``"full"`` makes the Laplace covariance the identity; ``"diagonal"`` only brings the curvature of each
        parameter to one, and ``"none"`` scales all parameters alike, so that the narrowest direction has unit SD."""
        if whitening == "full":
            return cls(mode.z, mode.scale)
        if whitening == "diagonal":
            curvature = torch.linalg.inv(mode.covariance).diagonal(dim1=-2, dim2=-1)
            return cls(mode.z, torch.diag_embed(curvature.rsqrt()))
        narrowest = torch.linalg.eigvalsh(mode.covariance)[:, :1].clamp_min(0.0).sqrt()
        return cls(mode.z, torch.diag_embed(narrowest.expand_as(mode.z)))

    def z(self, w: Float[Tensor, "*draw window d"]) -> Float[Tensor, "*draw window d"]:
        """``w`` ``(..., window, d)`` as log parameters (or whatever the density's unconstrained space is)."""
        return matvec(self.lower, w) + self.mode

    def pull_back(self, score: Float[Tensor, "*draw window d"]) -> Float[Tensor, "*draw window d"]:
        """A gradient in ``z`` as one in ``w``."""
        return matvec(self.lower.mT, score)

    def widest(self, mode: Mode) -> Float[Tensor, " window"]:
        """Largest SD that the Laplace approximation has along any direction of ``w``, ``(window,)``; 1 if whitened."""
        seen = torch.linalg.solve_triangular(self.lower, mode.scale, upper=False)
        return torch.linalg.matrix_norm(seen, ord=2)

    def slowed(self, slowdown: Float[Tensor, " window"]) -> Coordinates:
        """A step ``h/slowdown`` in ``w`` is a step ``h`` in these; ``slowdown`` ``(window,)``."""
        return Coordinates(self.mode, self.lower / slowdown.sqrt()[:, None, None])


def stiffness(density: Density, coordinates: Coordinates, *, radius: float = 3.0) -> Float[Tensor, " window"]:
    """Slope of the potential over that of its Laplace approximation ``radius`` SDs out: ``(window,)``, at least 1.

    A skewed posterior (a weak window) has a steep side on which the step that suits the mode overshoots; dividing the
    window's step by this keeps ``step x curvature`` what it is at the mode of a Gaussian.
    """
    d = coordinates.mode.shape[-1]
    axes = radius * torch.eye(d, dtype=coordinates.mode.dtype, device=coordinates.mode.device)
    probes = torch.cat([axes, -axes])[:, None, :].expand(-1, len(coordinates.mode), d)
    gradient = -coordinates.pull_back(score_of(density, coordinates.z(probes)))
    slope = (gradient * probes).sum(-1) / radius**2
    return slope.nan_to_num(nan=1e6, posinf=1e6).amax(0).clamp(1.0, 1e6)
