"""How heavy the tail of importance ratios is: the shape of a generalised Pareto law fitted to the largest of them."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from avtorch.arrays import Float

RELIABLE = 0.7
"""Above this shape a mean weighted by the ratios is unreliable for any number of them (Vehtari et al. 2024)."""


def reliable(draws: int) -> float:
    """The shape up to which a mean weighted by this many ratios is reliable: of 512 draws 0.63, of 2154 or more
    `RELIABLE` (Vehtari et al. 2024, section 3.2.3)."""
    return min(1 - 1 / math.log10(draws), RELIABLE) if draws > 10 else -math.inf


def tail_of(n: int) -> int:
    """How many of ``n`` ratios are their tail."""
    return max(5, math.ceil(min(n / 5, 3 * n**0.5)))


def pareto_k(log_ratio: Float[Tensor, "draw window"]) -> Float[Tensor, " window"]:
    """Shape ``k`` of the tail of ratios given by their logarithm ``(draw, window)``; returns ``(window,)``.

    Ratios have finite moments up to order ``1/k``. Of ``n`` of them the ``min(n/5, 3 sqrt n)`` largest are fitted, as
    in Pareto-smoothed importance sampling (Vehtari et al., JMLR 25(72), 2024). Infinite where a ratio is NaN or all
    are zero; minus infinity where the largest are all alike.
    """
    tail = tail_of(len(log_ratio))
    largest = log_ratio.masked_fill(log_ratio.isnan(), -torch.inf).topk(tail + 1, 0).values
    broken = log_ratio.isnan().any(0) | ~largest[0].isfinite()
    ratio = (largest - largest[0]).exp().nan_to_num(nan=0.0)
    excess = (ratio[:-1] - ratio[-1]).flip(0)  # ascending
    alike = excess[-1] < 1e-12
    k = _shape(torch.where(alike, 1.0, excess))
    return k.masked_fill(alike, -torch.inf).masked_fill(broken, torch.inf)


def _shape(x: Tensor) -> Tensor:
    """Shape of a generalised Pareto law (Zhang and Stephens, Technometrics 51, 2009); ``x`` ``(n, window)`` rises.

    The posterior mean over a grid of its other parameter, and a weak prior at 0.5 that weighs as much as ten ratios.
    """
    n = len(x)
    count = 30 + int(n**0.5)
    steps = 1 - (count / (torch.arange(1, count + 1, dtype=x.dtype, device=x.device) - 0.5)).sqrt()
    quarter = x[int(n / 4 + 0.5) - 1].clamp_min(1e-300)
    b = steps[:, None] / (3 * quarter) + 1 / x[-1]
    k = torch.log1p(-b[:, None] * x).mean(1)
    profile = n * ((-b / k).log() - k - 1)
    b = (profile.nan_to_num(nan=-torch.inf).softmax(0) * b).sum(0)
    return (n * torch.log1p(-b * x).mean(0) + 5) / (n + 10)
