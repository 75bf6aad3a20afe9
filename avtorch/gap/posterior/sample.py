"""Posterior draws of a fitted model: SGLD on the exact density, and importance sampling where SGLD fails.

The sampler is the project's own, with parallel chains, whitened at the mode. Rollouts of a long drive are expensive, so
most gradients come from a `Surrogate`, corrected at random steps (`Corrected`). The correction rate follows from the
surrogate's error, up to the exact gradient at every step.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from avtorch.arrays import FloatArray
from avtorch.errors import InputError
from avtorch.gap.posterior.density import RolloutDensity, root
from avtorch.gap.posterior.draws import Draws
from avtorch.gap.posterior.importance_sampling import effective_sample_size, importance
from avtorch.gap.posterior.summary import lag_and_gain, repaired, reported, reported_draws
from avtorch.gap.posterior.surrogate import Corrected, Surrogate, trusted_square
from avtorch.gap.search.fitted_model import FittedModel
from avtorch.inference.coordinates import Coordinates, stiffness
from avtorch.inference.map import Mode, find_mode
from avtorch.inference.sampler import sample
from avtorch.inference.sampler_settings import SamplerSettings

__all__ = ["Draws", "exact_one_in", "fitted", "lag_and_gain", "posterior", "repaired", "reported", "reported_draws"]


STEP = 2.0
"""SGLD's step in whitened coordinates; see `SamplerSettings`."""
_INFLATED = 0.02  # relative increase of a variance by gradient noise
_THROWN = 3.0  # [posterior standard deviations] largest displacement by one correction
_RAREST = 16.0
_CLIFF = 9.0  # mean square error of the surrogate's whitened gradient above which no step size suits the posterior
_STEPS = 500.0  # largest number of SGLD steps
_ROWS = 2.5e7  # largest number of rows in exact gradients, about ten seconds on one core
_CHECKED = 160  # number of draws that are checked
_LET_PASS = 0.15  # tolerated relative error of a variance
_ROUNDS = 12
_ENOUGH = 250.0  # effective sample size at which importance sampling stops
_FEWEST = 30.0  # effective sample size below which the draws are discarded


def posterior(found: FittedModel, *, chains: int = 16, draws: int = 50, seed: int = 0) -> Draws:
    """Draws of the hypothesis's parameters given its log, with noise model and onset held.

    Raises `InputError` for fewer than 1 chain or 4 draws.
    """
    if chains < 1 or draws < 4:
        raise InputError(f"draws: found {chains} chains of {draws}, needs 1 or more of 4 or more")
    density = RolloutDensity.of(found)
    surrogate, mode = fitted(density, found.covariance)
    generator = torch.Generator().manual_seed(seed)
    points = exact_one_in(density, surrogate, mode, generator)
    z, why = None, "gradients jump within a posterior standard deviation"
    if points:
        z, why = _walked(Corrected(density, surrogate, mode, points), chains, draws, generator)
    if z is not None:
        method, share, worth = "sgld", 1 / points, _worth(z)
    else:
        z, worth = _weighted(density, mode, chains, draws, seed)
        method, share = "importance" if worth >= _FEWEST else "laplace", 1.0
        if method == "laplace":
            noise = torch.randn(chains, draws, density.hypothesis.size, dtype=torch.float64, generator=generator)
            z = torch.as_tensor(found.z) + noise @ root(found.covariance).mT
    values = density.constrain(z)
    return Draws(
        names=density.names,
        z=z.numpy(),
        values={name: values[..., i].numpy() for i, name in enumerate(density.names)},
        method=method,
        effective=worth,
        grade_rms=_grade(density, z, seed),
        exact_share=share,
        why=why,
    )


def _walked(target: Corrected, chains: int, draws: int, generator: torch.Generator) -> tuple[Tensor | None, str]:
    """SGLD draws of `z` (chain, draw, coordinate), or None and the reason; the number of gradients is bounded."""
    density, mode = target.exact, target.mode
    steepness = float(stiffness(density, Coordinates.of(mode)))
    exact = chains / target.points  # exact gradients per step
    rows = sum(len(d.time) for d in density.hypothesis.record.drives)
    steps = min(_STEPS, _ROWS / rows / exact)
    thinning = 2 if draws * 2 + 4 <= steps else 1
    longest = max([1.0, *(t for t in (1.5, 2.0, 3.0, 4.0) if (4 * t + thinning * draws) * t <= steps)])
    if steepness > 2 * longest:
        steep = f"in places {steepness:.0f} times as steep"
        return None, f"its shape is far from normal ({steep}), and SGLD would take too long"
    settings = SamplerSettings(
        chains=chains,
        draws=draws,
        burn_in=4,
        thinning=thinning,
        step=STEP,
        spread=1.0,
        longest=longest,
        attempts=1,
        batch=1 if target.points > 1 else None,
        compare=False,  # too expensive at hundreds of points; Stein's identity below replaces it
    )
    walked = sample(target, settings, generator=generator, mode=mode)
    if not bool(walked.converged[0]):
        return None, walked.why[0]
    z = density.unconstrain(walked.draws[:, :, 0])
    off = stein_discrepancy(density, mode, z, generator)
    if off > 0:
        return None, f"by Stein's identity a variance of its draws is off by {off:.2g}, on a posterior with kinks"
    return z, ""


def stein_discrepancy(density: RolloutDensity, mode: Mode, z: Tensor, generator: torch.Generator) -> float:
    """Largest violation of Stein's identity by draws `z` (chain, draw, coordinate); 0 where it is not significant.

    Under the posterior the mean of `(w - mean) dU/dw` is 1 for each coordinate. A share of the variance and three
    standard errors are tolerated.
    """
    flat = z.flatten(0, 1)
    some = flat[torch.randperm(len(flat), generator=generator)[:_CHECKED]][:, None]
    slope = -(density.score(some) @ mode.scale[0])[:, 0]
    away = torch.linalg.solve_triangular(mode.scale[0], (some[:, 0] - flat.mean(0)).mT, upper=False).mT
    products = away * slope
    off = (products.mean(0) - 1).abs()
    excess = off - _LET_PASS - 3 * products.std(0) / len(products) ** 0.5
    return float(off.max()) if bool((excess > 0).any()) else 0.0


def _weighted(density: RolloutDensity, mode: Mode, chains: int, draws: int, seed: int) -> tuple[Tensor, float]:
    """Draws resampled by importance, and their effective sample size."""
    rows = sum(len(d.time) for d in density.hypothesis.record.drives)
    size = int(min(400, max(80, 2 * _ROWS / rows / _ROUNDS)))  # no gradients, so half the cost

    def log_prob(z: FloatArray) -> FloatArray:
        return density.value(torch.as_tensor(z)[:, None])[:, 0].numpy()

    centre, scale = mode.z[0].numpy(), mode.scale[0].numpy()
    places, weights = importance(log_prob, centre, scale, rounds=_ROUNDS, size=size, enough=_ENOUGH, seed=seed)
    rng = np.random.default_rng(seed)
    # systematic resampling: each point is drawn in proportion to its weight, to within one
    at = (rng.random() + np.arange(chains * draws)) / (chains * draws)
    chosen = np.searchsorted(np.cumsum(weights), at).clip(0, len(weights) - 1)
    z = places[rng.permutation(chosen)]
    return torch.as_tensor(z.reshape(chains, draws, -1)), effective_sample_size(weights)


def _worth(z: Tensor) -> float:
    """Effective sample size of draws (chain, draw, coordinate), for the slowest coordinate, from the chains' means."""
    chains, draws, _ = z.shape
    if chains < 2:
        return float(draws)
    between = z.mean(1).var(0) / z.var((0, 1)).clamp_min(1e-300)
    return float((chains * draws) / (draws * between).clamp_min(1.0).max())


def fitted(density: RolloutDensity, covariance: FloatArray) -> tuple[Surrogate, Mode]:
    """A surrogate around the density's mode, and that mode; `covariance`: Laplace's, where known."""
    centre, scale = torch.as_tensor(density.centre), root(covariance)
    for turn in range(3):
        surrogate = Surrogate.of(density, centre, scale)
        mode = find_mode(surrogate)
        away = torch.linalg.solve_triangular(scale, torch.stack([mode.z[0] - centre], -1), upper=False)
        ratio = torch.linalg.solve_triangular(scale, mode.scale[0], upper=False)
        spread = torch.linalg.svdvals(ratio)
        near = float(away.abs().max()) < 0.5 and float(spread.max()) < 1.5 and float(spread.min()) > 0.6
        if near or turn == 2 or not bool(mode.converged[0]):
            break
        step = away[:, 0] / away.abs().max().clamp_min(2.0) * 2.0
        centre = centre + scale @ step
        scale = mode.scale[0] if float(spread.max()) < 4 else scale
    if not bool(mode.converged[0]):  # far from any quadratic: keep the mode and spread of the fit
        mode = Mode(centre[None], scale[None], torch.zeros(1, dtype=scale.dtype), torch.tensor([True]))
    exact = density.value(mode.z)
    return surrogate, Mode(mode.z, mode.scale, exact, mode.converged)


def exact_one_in(density: RolloutDensity, surrogate: Surrogate, mode: Mode, generator: torch.Generator) -> int:
    """The interval n at which gradients must be exact, so that their noise widens the posterior within tolerance.

    Noise of variance s² in whitened gradients widens a variance by `step s² / 4`. Correcting one gradient in n leaves
    `(n - 1)` times the squared error of the surrogate, measured at slightly widened draws from Laplace's approximation.
    0 where that error is so large that the posterior is too steep for SGLD. At the limit of the surrogate's range, a
    single correction must not displace a chain far either.
    """
    size, count = mode.z.shape[-1], 16
    w = torch.randn(count + size, 1, size, dtype=mode.z.dtype, generator=generator)
    edge, length = trusted_square(size) ** 0.5, w.norm(dim=-1, keepdim=True)
    w = torch.cat([1.2 * w[:count] * (edge / (1.2 * length[:count])).clamp_max(1.0), w[count:] * edge / length[count:]])
    z = mode.z + w @ mode.scale[0].mT
    lacking = (density.score(z) - surrogate.score(z)) @ mode.scale[0]
    if not bool(lacking.isfinite().all()):
        return 0
    typical = float(lacking[:count].square().mean(0).max().clamp_min(1e-12))
    if typical > _CLIFF:
        return 0
    farthest = float(lacking[count:].abs().max().clamp_min(1e-12))
    return int(min(_RAREST, 1 + 4 * _INFLATED / (STEP * typical), 1 + _THROWN / farthest))


def _grade(density: RolloutDensity, z: Tensor, seed: int) -> FloatArray | None:
    """Root mean square of the road grade, (chain, draw), for draws of `z` (chain, draw, coordinate)."""
    slope = density.slope
    if slope is None:
        return None
    match = density.images(z.reshape(-1, z.shape[-1])) @ slope.image.T
    road = slope.sampled(match, np.random.default_rng(seed))
    return density.hypothesis.grade_along(road).reshape(z.shape[:-1])
