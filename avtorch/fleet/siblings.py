"""How far each car is from its siblings, by what is predicted of it from all the others alone.

The mean over cars has a normal belief in closed form once the spreads are given, so each car can be left out exactly,
at every point of a grid over the spreads. A car that counted among those that tell the spread would widen it and so
hide itself.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from avtorch.inference.population import MEAN_SD, SPREAD, PopulationMargin

GRID = (32, 24)
"""Points of the grid over the spread between cars, and over that between drives."""

NARROWINGS = 3
"""Times that the grid is drawn in to where some car's belief is."""

WIDEST = (math.log(1e-3), math.log(4.0))
"""Of the logarithm of a spread."""

_OUTSIDE = 1e-9
"""Share of a belief that a grid that is drawn in may leave outside at either end."""


def left_out(margin: PopulationMargin) -> tuple[Tensor, Tensor]:
    """Of each car what its siblings predict, and the two-sided tail probability of its own drives under it.

    Both `(quantity, car)`; the prediction is the mean of the logarithm.
    """
    found = [_left_out(margin.select(torch.tensor([i]))) for i in range(margin.windows)]
    return torch.stack([mean for mean, _ in found]), torch.stack([tail for _, tail in found])


def _left_out(margin: PopulationMargin) -> tuple[Tensor, Tensor]:
    between, within = (torch.linspace(*WIDEST, n, dtype=torch.float64) for n in GRID)
    if not margin.repeated:
        within = torch.full((1,), -math.inf, dtype=torch.float64)
    for _ in range(NARROWINGS):
        weight, *_ = _grid(margin, between, within)
        between = _narrowed(between, weight.sum(1))
        within = _narrowed(within, weight.sum(0)) if margin.repeated else within
    weight, below, centre = _grid(margin, between, within)
    share, over = (weight * below).sum((0, 1)), (weight * (1 - below)).sum((0, 1))
    return (weight * centre).sum((0, 1)), (2 * torch.minimum(share, over)).clamp(0.0, 1.0)


def _grid(margin: PopulationMargin, between: Tensor, within: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """`(between, within, car)`: belief in each point without the car, probability of an estimate below its own, and the
    mean over the other cars."""
    log_weight, below, centres = [], [], []
    for spread in within:
        mean, precision, left = (x[0] for x in margin.of_cars(spread.exp()[None]))
        variance = between.exp().square()[:, None] + 1 / precision
        w = 1 / variance
        # sums over all cars, less the car's own; the prior of the mean counts as one more, of mean 0
        total, weighted, square, logs = (
            x.sum(-1, keepdim=True) - x for x in (w, w * mean, w * mean.square(), w.log() + 2 * left)
        )
        total = total + 1 / MEAN_SD**2
        centre = weighted / total
        evidence = 0.5 * (logs - total.log() - square + weighted * centre)
        prior = 2 * between[:, None] - 2 / SPREAD * between[:, None].exp()
        if margin.repeated:
            prior = prior + 2 * spread - 2 / SPREAD * spread.exp()
        log_weight.append(evidence + prior)
        centres.append(centre)
        below.append(torch.special.ndtr((mean - centre) / (variance + 1 / total).sqrt()))
    log_weight = torch.stack(log_weight, 1)
    weight = log_weight.flatten(0, 1).softmax(0).unflatten(0, log_weight.shape[:2])
    return weight, torch.stack(below, 1), torch.stack(centres, 1)


def _narrowed(grid: Tensor, weight: Tensor) -> Tensor:
    """As many points between the outermost ones that some car's belief reaches; `weight` `(point, car)`."""
    inside = (weight.amax(1) > _OUTSIDE).nonzero().flatten()
    low, high = max(int(inside[0]) - 1, 0), min(int(inside[-1]) + 1, len(grid) - 1)
    return torch.linspace(float(grid[low]), float(grid[high]), len(grid), dtype=grid.dtype)
