"""Is there a mode that the chains never reached? Searches that start far from the draws ascend the density."""

from __future__ import annotations

import math
from functools import lru_cache

import torch
from torch import Tensor

from avtorch.arrays import Float
from avtorch.inference.coordinates import score_of
from avtorch.inference.density import Density, has_selection
from avtorch.inference.map import find_mode
from avtorch.inference.planes import lower_times, lower_transposed_times

#: Distances of the starts in SDs of the draws, evenly spaced; these are half of them, the others are mirror images.
RADII = (4.0, 16.0)
STARTS, STEPS = 16, 3
#: Longest step of the climb, in the same SDs.
STRIDE = 10.0
#: Nats below the draws' centre, and SDs away from it, at which an end point is searched for a mode.
DEPTH, FAR = 7.0, 5.0
#: Share of the posterior's mass (by Laplace) from which a mode must not be missed.
MASS = 0.005


def missed_mass(
    density: Density, mean: Float[Tensor, "window parameter"], lower: Float[Tensor, "window parameter parameter"]
) -> Float[Tensor, " window"]:
    """Mass of the heaviest mode found far from the draws, over that at the draws, ``(window,)``; 0 where none was.

    Args:
        mean, lower: the draws' mean ``(window, parameter)`` and triangular root of their covariance.
    """
    w = starts(mean.shape[-1]).to(mean.device)[:, None].expand(-1, len(mean), -1)
    try:
        for _ in range(STEPS):
            slope = lower_transposed_times(lower, score_of(density, lower_times(lower, w) + mean))
            w = w + slope * (STRIDE / slope.square().sum(-1, keepdim=True).sqrt_()).clamp_max_(1.0)
        w = w.nan_to_num(nan=0.0, posinf=0.0, neginf=0.0)
        with torch.no_grad():
            end = lower_times(lower, w) + mean
            height = density.log_prob(torch.cat([mean[None], end]))
    except ValueError:  # a user's function that raises this far out: no search ends there
        return mean.new_zeros(len(mean))
    high = (w.square().sum(-1) > FAR**2) & (height[1:] > height[:1] - DEPTH)
    missed = mean.new_zeros(len(mean))
    index = high.any(0).nonzero().squeeze(-1)
    if not len(index) or not (has_selection(density) or len(mean) == 1):
        return missed
    best = height[1:].masked_fill(~high, -torch.inf).argmax(0)[index]
    chosen = density.select(index) if has_selection(density) and len(index) < len(mean) else density
    other = find_mode(chosen, start=end[best, index])
    away = torch.linalg.solve_triangular(lower[index], (other.z - mean[index])[..., None], upper=False)[..., 0]
    volume = (other.scale.diagonal(dim1=-2, dim2=-1).abs().log() - lower[index].diagonal(dim1=-2, dim2=-1).log()).sum(
        -1
    )
    # a skewed posterior's own mode lies near its draws; the density at their centre replaces it
    ratio = (other.log_prob - height[0, index] + volume).exp()
    there = other.converged & (away.norm(dim=-1) > FAR) & (ratio > MASS)
    return missed.index_put((index,), torch.where(there, ratio, 0.0))


@lru_cache(maxsize=32)
def starts(d: int) -> Float[Tensor, "start d"]:
    """``(start, d)``: directions at random but always the same, and their mirror images, at rising radii."""
    half = STARTS // 2
    direction = torch.randn(half, d, dtype=torch.float64, generator=torch.Generator().manual_seed(100 + d))
    radius = torch.linspace(math.log(RADII[0]), math.log(RADII[1]), half, dtype=torch.float64).exp()
    direction = direction / direction.norm(dim=-1, keepdim=True) * radius[:, None]
    return torch.cat([direction, -direction])
