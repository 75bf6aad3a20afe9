"""The posterior of a found candidate: SGLD on the exact density, and the quantities an answer holds.

The sampler is the project's own, chains side by side, whitened at the mode. Rollouts of a long drive are dear, so most
gradients are those of a `Surrogate`, set right at random steps (`Corrected`); how often is read off from how good it
is, down to the exact gradient at each step.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from avtorch.arrays import FloatArray
from avtorch.errors import InputError
from avtorch.gap.posterior.density import RolloutDensity, root
from avtorch.gap.posterior.draws import Draws
from avtorch.gap.posterior.importance_sampling import effective, importance
from avtorch.gap.posterior.summary import drawn, moved, repaired, reported
from avtorch.gap.posterior.surrogate import Corrected, Surrogate, trusted_square
from avtorch.gap.search.fitted_model import FittedModel
from avtorch.inference.map import Mode, find_mode
from avtorch.inference.sampler import SamplerSettings, sample
from avtorch.inference.whitening import Coordinates, stiffness

__all__ = ["Draws", "drawn", "exact_one_in", "fitted", "moved", "posterior", "repaired", "reported"]


STEP = 2.0
"""SGLD's step in whitened coordinates; see `SamplerSettings`."""
_INFLATED = 0.02  # of a variance, by the noise of gradients
_THROWN = 3.0  # [posterior standard deviations] by one correction
_RAREST = 16.0
_CLIFF = 9.0  # mean square of what the surrogate's whitened gradient lacks, where no step suits the posterior
_STEPS = 500.0  # SGLD steps affordable
_ROWS = 2.5e7  # rows of exact gradients affordable, some ten seconds of one core
_CHECKED = 160  # of the draws
_LET_PASS = 0.15  # relative error of a variance
_ROUNDS = 12
_ENOUGH = 250.0  # effective draws by importance
_FEWEST = 30.0  # effective draws, fewer than which are none


def posterior(found: FittedModel, *, chains: int = 16, draws: int = 50, seed: int = 0) -> Draws:
    """Draws of the candidate's parameters given its log, noise model and onset held.

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
    """SGLD's draws of `z` (chain, draw, coordinate), or None and why not; no more gradients than are affordable."""
    density, mode = target.exact, target.mode
    pace = float(stiffness(density, Coordinates.of(mode)))
    exact = chains / target.points  # gradients a step
    rows = sum(len(d.time) for d in density.hypothesis.record.drives)
    steps = min(_STEPS, _ROWS / rows / exact)
    thinning = 2 if draws * 2 + 4 <= steps else 1
    longest = max([1.0, *(t for t in (1.5, 2.0, 3.0, 4.0) if (4 * t + thinning * draws) * t <= steps)])
    if pace > 2 * longest:
        return None, f"its shape is far from normal (in places {pace:.0f} times as steep), and SGLD would take too long"
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
        compare=False,  # too dear at hundreds of points; Stein's identity below takes its place
    )
    walked = sample(target, settings, generator=generator, mode=mode)
    if not bool(walked.converged[0]):
        return None, walked.why[0]
    z = density.unconstrain(walked.draws[:, :, 0])
    off = stein_discrepancy(density, mode, z, generator)
    if off > 0:
        return None, f"by Stein's identity its draws are {off:.2g} off in a variance, on a posterior with kinks"
    return z, ""


def stein_discrepancy(density: RolloutDensity, mode: Mode, z: Tensor, generator: torch.Generator) -> float:
    """How far draws `z` (chain, draw, coordinate) are from having the density's gradients; 0 where chance explains it.

    Over a posterior the mean of `(w - mean) dU/dw` is 1 for each coordinate. A share of the variance is let pass, and
    three standard errors.
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
    """Draws resampled by importance, and how many they are worth."""
    rows = sum(len(d.time) for d in density.hypothesis.record.drives)
    size = int(min(400, max(80, 2 * _ROWS / rows / _ROUNDS)))  # no gradients, half as dear

    def log_prob(z: FloatArray) -> FloatArray:
        return density.value(torch.as_tensor(z)[:, None])[:, 0].numpy()

    centre, scale = mode.z[0].numpy(), mode.scale[0].numpy()
    places, weights = importance(log_prob, centre, scale, rounds=_ROUNDS, size=size, enough=_ENOUGH, seed=seed)
    rng = np.random.default_rng(seed)
    # systematic: each place comes as often as it weighs, but for one
    at = (rng.random() + np.arange(chains * draws)) / (chains * draws)
    chosen = np.searchsorted(np.cumsum(weights), at).clip(0, len(weights) - 1)
    z = places[rng.permutation(chosen)]
    return torch.as_tensor(z.reshape(chains, draws, -1)), effective(weights)


def _worth(z: Tensor) -> float:
    """Effective number of draws (chain, draw, coordinate), of the slowest coordinate, by the chains' means."""
    chains, draws, _ = z.shape
    if chains < 2:
        return float(draws)
    between = z.mean(1).var(0) / z.var((0, 1)).clamp_min(1e-300)
    return float((chains * draws) / (draws * between).clamp_min(1.0).max())


def fitted(density: RolloutDensity, covariance: FloatArray) -> tuple[Surrogate, Mode]:
    """A surrogate about the density's mode, and that mode; `covariance`: Laplace's, as far as it is known."""
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
    if not bool(mode.converged[0]):  # far from any quadratic: the fit's own mode and spread
        mode = Mode(centre[None], scale[None], torch.zeros(1, dtype=scale.dtype), torch.tensor([True]))
    exact = density.value(mode.z)
    return surrogate, Mode(mode.z, mode.scale, exact, mode.converged)


def exact_one_in(density: RolloutDensity, surrogate: Surrogate, mode: Mode, generator: torch.Generator) -> int:
    """One gradient in how many has to be exact, so that their noise widens the posterior by no more than told.

    A noise of variance s² in whitened gradients widens a variance by `step s² / 4`; correcting one in n leaves
    `(n - 1)` times the square of what the surrogate lacks, measured at draws from Laplace's approximation, a little
    widened. 0 where it lacks so much that the posterior has cliffs. Where the surrogate is trusted at the farthest,
    one correction must not throw a chain far either.
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
    """Root mean square of the slope found, (chain, draw), for draws of `z` (chain, draw, coordinate)."""
    slope = density.slope
    if slope is None:
        return None
    match = density.images(z.reshape(-1, z.shape[-1])) @ slope.image.T
    road = slope.sampled(match, np.random.default_rng(seed))
    return density.hypothesis.grade_along(road).reshape(z.shape[:-1])
