"""Distance of draws from the truth, and how fast the chains mix."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from benchmarks.bias.windows import Problem

#: A chain with a draw this many posterior SDs from the mode has diverged, or never approached it: it is lost.
FAR = 50.0
#: Blocks of steps whose means give the Monte Carlo error, also where all chains share their minibatches.
BLOCKS = 20


@dataclass(frozen=True)
class Measured:
    """Per window ``(window,)``; the worst of the three parameters each, NaN where the window's chains are lost.

    Attributes:
        mean_difference: largest absolute difference of means in SDs of the truth.
        sd_ratio: SD over the truth's, of the parameter where it is furthest from one.
        parameter: which that is.
        sd_error: Monte Carlo standard error of that.
        one_chain: the same ratio from the spread within single chains.
        ess_per_step: effective draws a step of one chain, for the mean or for the variance, whichever are fewer.
        lost: ``(window,)`` bool.
    """

    mean_difference: Tensor
    sd_ratio: Tensor
    parameter: Tensor
    sd_error: Tensor
    one_chain: Tensor
    ess_per_step: Tensor
    lost: Tensor


def measure(problem: Problem, z: Tensor) -> Measured:
    """Draws of ``z`` ``(chain, step, window, parameter)``, one a step, against quadrature."""
    mode, truth = problem.mode, problem.truth
    whitened = torch.einsum("wij,cnwj->cnwi", torch.linalg.inv(mode.scale), z - mode.z)
    lost = ~(whitened.abs() < FAR).all(-1).all(0).all(0)  # NaN counts as far
    score = (torch.where(lost[:, None], 0.0, z.exp()) - truth.mean) / truth.sd
    shift = score.mean((0, 1))
    centred = score - shift
    ratio = centred.square().mean((0, 1)).sqrt()
    size = z.shape[1] // BLOCKS
    blocks = centred[:, : size * BLOCKS].unflatten(1, (BLOCKS, size)).square().mean((0, 2))
    error = blocks.std(0) / BLOCKS**0.5 / (2 * ratio)
    single = centred.sub(centred.mean(1, keepdim=True)).square().mean((0, 1)).sqrt()

    def clean(value: Tensor) -> Tensor:
        return torch.where(lost, torch.nan, value)

    worst = furthest(ratio)
    return Measured(
        clean(shift.abs().amax(-1)),
        clean(ratio.gather(-1, worst).squeeze(-1)),
        worst.squeeze(-1),
        clean(error.gather(-1, worst).squeeze(-1)),
        clean(single.gather(-1, furthest(single)).squeeze(-1)),
        clean(effective(centred).amin(-1) / (z.shape[0] * z.shape[1])),
        lost,
    )


def furthest(ratio: Tensor) -> Tensor:
    """Index of the parameter whose ratio is furthest from one, ``(..., 1)``."""
    return ratio.clamp_min(1e-300).log().abs().argmax(-1, keepdim=True)


def effective(centred: Tensor) -> Tensor:
    """Effective draws in ``(chain, step, ...)`` for the mean or for the variance, whichever are fewer."""
    squares = centred.square()
    squares = squares - squares.mean((0, 1))
    times = torch.maximum(autocorrelation_time(centred), autocorrelation_time(squares))
    return centred.shape[0] * centred.shape[1] / times


def autocorrelation_time(centred: Tensor) -> Tensor:
    """Integrated autocorrelation time [steps] of ``(chain, step, ...)``, mean over chains, as Geyer's initial sequence.

    About the common mean of all chains, so that chains that stand still are detected; below one where steps alternate.
    """
    steps = centred.shape[1]
    spectrum = torch.fft.rfft(centred, 2 * steps, dim=1)
    acov = torch.fft.irfft(spectrum.abs().square().mean(0), 2 * steps, dim=0)[:steps] / steps
    rho = acov / acov[:1].clamp_min(1e-300)
    half = steps // 2
    pairs = rho[: 2 * half].unflatten(0, (half, 2)).sum(1)
    positive = (pairs > 0).cumprod(0)
    return (2 * (pairs * positive).sum(0) - 1).clamp_min(1 / steps)
