"""What draws say of themselves: quantiles, nested R-hat, effective numbers of draws."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from avtorch.arrays import Float


def quantiles_of(draws: Float[Tensor, "draw *rest"], *q: float) -> tuple[Float[Tensor, "*rest"], ...]:
    """Quantiles along the first dimension, linear between order statistics; no more is sorted than is needed."""
    position = np.array(q) * (len(draws) - 1)
    low = position.astype(int)
    high = np.minimum(low + 1, len(draws) - 1)
    ordered = np.partition(draws.movedim(0, -1).cpu().numpy(), np.union1d(low, high), axis=-1)
    found = ordered[..., low] + (position - low) * (ordered[..., high] - ordered[..., low])
    return torch.from_numpy(found).to(draws).unbind(-1)


def nested_rhat(draws: Float[Tensor, "chain draw *rest"], groups: int = 8) -> Float[Tensor, "*rest"]:
    """Split nested R-hat (Margossian et al. 2024) over ``(chain, draw, ...)``; returns the remaining shape.

    Many short chains are joined into ``groups`` superchains, cut into halves: the plain R-hat of chains of a few
    autocorrelation times each is large even at stationarity. A common drift shows up between the halves, a chain in
    another place between the groups.
    """
    half = draws.shape[1] // 2
    used = (draws[:, : 2 * half] - draws[0, 0]).movedim((0, 1), (-1, -2))  # near zero the sums keep their digits
    sums, squares = (x.unflatten(-2, (2, half)).sum(-2) for x in (used, used.square()))
    return rhat_of_halves(sums, squares, half, groups)


def rhat_of_halves(
    sums: Float[Tensor, "*rest 2 chain"], squares: Float[Tensor, "*rest 2 chain"], half: int, groups: int = 8
) -> Float[Tensor, "*rest"]:
    """As :func:`nested_rhat`, from the sums over the ``half`` draws of each chain's halves, and of their squares."""
    groups = min(groups, sums.shape[-1])
    members = sums.shape[-1] // groups
    each = (x[..., : groups * members].unflatten(-1, (groups, members)).sum(-1) for x in (sums, squares))
    mean, square = (x.flatten(-2) / (members * half) for x in each)
    within = (square - mean.square()).mean(-1)
    return (1 + mean.var(-1) / within.clamp_min(torch.finfo(mean.dtype).tiny)).sqrt()


def normal_scores(draws: Float[Tensor, "chain draw *rest"]) -> Float[Tensor, "chain draw *rest"]:
    """Each number's normal quantile by its rank among all chains' and draws', shape of ``draws``; ties as they come."""
    flat = draws.flatten(0, 1)
    rank = flat.argsort(0).argsort(0) + 1
    return torch.special.ndtri((rank - 0.375) / (len(flat) + 0.25)).unflatten(0, draws.shape[:2])


def effective_sample_size(values: Float[Tensor, "chain draw *rest"]) -> Float[Tensor, "*rest"]:
    """Number of independent values that give the mean of ``(chain, draw, ...)`` as precisely; returns the remaining
    shape.

    By the means of independent chains, each cut into pieces where there are fewer than sixteen: short chains do not
    determine their own autocorrelation. NaN where all values are equal.
    """
    chains, draws = values.shape[:2]
    pieces = max(1, min(draws // 2, -(-16 // chains)))
    means = values[:, : draws // pieces * pieces].unflatten(1, (pieces, -1)).mean(2).flatten(0, 1)
    return values.flatten(0, 1).var(0) * len(means) / means.var(0)
