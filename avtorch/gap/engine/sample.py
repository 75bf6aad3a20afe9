r"""Posterior draws of a hypothesis's coordinates: by SGLD, by importance where SGLD fails, or Laplace's.

The sampler is the project's own (`avtorch.inference`), with parallel chains, whitened at the mode of a `Surrogate`.
Most of its gradients are the surrogate's, corrected at random steps; how often follows from the surrogate's error.
Chains must agree (nested R-hat), and draws satisfy Stein's identity of the exact density. All draws are of the tempered
density; then they are stretched to cover what parts of the drive disagree on.

Laplace's draws are

    x ~ N(m, A^-1) within limits,    A = temper W W' + prior precision,    m = mode of the tempered density

with W the Jacobian in units of the noise. Where scores s_f of parts of the drive scatter more than A says, the model is
wrong there, and the covariance is widened, direction by direction, to the sandwich

    A^-1 temper^2 J A^-1,    J = sum of s_f s_f' over frames, neighbours included (Newey and West 1987), or over halves

(Huber 1967; White 1982). With halves an interval of 90 % covers what each of them alone would say.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal

import numpy as np
import torch
from scipy.special import ndtr, ndtri
from torch import Tensor

from avtorch.arrays import FloatArray
from avtorch.gap.engine.coordinates import INDEX
from avtorch.gap.engine.density import HypothesisDensity, support
from avtorch.gap.engine.evidence import log_prior
from avtorch.gap.engine.gauss_newton import force_columns, jacobian, prior_terms, whitened_jacobian
from avtorch.gap.engine.hypothesis import Hypothesis
from avtorch.gap.engine.likelihood import whiten
from avtorch.gap.engine.priors import TEMPER
from avtorch.gap.engine.surrogate import Corrected, Surrogate, terms_of
from avtorch.gap.engine.torch_plant import not_in_torch
from avtorch.inference.chains import effective_sample_size
from avtorch.inference.coordinates import Coordinates, stiffness
from avtorch.inference.importance import ImportanceSettings, reliable, weighted_draws
from avtorch.inference.map import Mode, find_mode
from avtorch.inference.sampler import sample as walk
from avtorch.inference.sampler_settings import SamplerSettings

STEP = 2.0
"""SGLD's step in whitened coordinates; see `SamplerSettings`."""

_INFLATED = 0.05  # relative increase of a variance by gradient noise
_THROWN = 3.0  # [posterior standard deviations] largest displacement by one correction
_RAREST = 16.0  # steps between corrections
_PROBES = 16  # places where the surrogate's error is measured
_REACHES = (3.0, 2.2, 1.6)  # of the surrogate, in standard deviations of its draws a root of their dimension
_CLIFF = 9.0  # mean square error of the surrogate's whitened gradient above which no step suits the density
_STEPS = 300.0  # of SGLD, most
_GRADIENT_STEPS = 1.2e7  # of the grid in exact gradients of the walk, most: five seconds on one core
_LONGEST = 500_000  # steps of a grid whose responses fit in memory
_CHECKED = 96  # draws that Stein's identity is checked at
_LET_PASS = 0.15  # relative error of a variance
_WIDER = 1.2  # spread of the surrogate's responses over that of the draws
_SOUGHT = ImportanceSettings(rounds=4, enough=150.0)  # draws of the surrogate that the next one is fitted to
_WEIGHED = ImportanceSettings(draws=200, rounds=4, enough=200.0)
_FEWEST = 50.0  # effective draws
_TRIED_DRAWS = 64  # normal draws a draw before limits are met one coordinate at a time
_GIBBS_SWEEPS = 50


@dataclass(frozen=True, eq=False)
class Draws:
    """Draws `x` (chain, draw, coordinate) of the coordinates `names`; one at a limit that is out of reach is constant.

    `method`: "sgld"; "importance" where the density is too steep in places for Langevin steps; "laplace" where both
    fail or there is no gradient; `why` says so. `effective`: effective number of draws of the slowest coordinate.
    """

    names: tuple[str, ...]
    x: FloatArray = field(repr=False)
    method: Literal["sgld", "importance", "laplace"]
    effective: float
    why: str = ""

    def __getitem__(self, name: str) -> FloatArray:
        """Draws (chain, draw) of a coordinate."""
        return self.x[..., self.names.index(name)]


def sample(
    h: Hypothesis,
    *,
    chains: int = 16,
    draws: int = 50,
    seed: int = 0,
    temper: float = TEMPER,
    method: Literal["sgld", "laplace"] = "sgld",
    widen: bool = True,
) -> Draws:
    """Draws of the free coordinates of a fitted, evaluated hypothesis; its onsets and shift speeds are held.

    `method` "laplace" asks for normal draws alone. `widen` False: draws of the density itself.
    """
    rng = np.random.default_rng(seed)
    normal = Laplace.of(h, temper=temper)
    why = "" if method == "sgld" else "not asked for"
    why = why or not_in_torch(h)
    if not why and len(h.data.grid.time) > _LONGEST:
        why = "the drive is too long for gradients"
    found = None
    if not why:
        density = HypothesisDensity(h, temper, normal.names, np.sqrt(np.diag(normal.covariance)))
        generator = torch.Generator().manual_seed(seed)
        try:
            found, why = _sampled(density, normal, chains, draws, generator)
        except torch.linalg.LinAlgError:  # pyright: ignore[reportPrivateImportUsage]
            why = "the surrogate's draws have no covariance"
    if found is None:
        x = normal.draws(chains * draws, rng, widen=widen).reshape(chains, draws, -1)
        found = Draws(normal.names, x, "laplace", float(chains * draws), why=why)
    elif widen:
        found = replace(found, x=normal.stretched(found.x))
    x = np.empty((chains, draws, len(h.free)))
    for k, name in enumerate(h.free):
        x[..., k] = found[name] if name in found.names else h[name]
    return replace(found, names=tuple(h.free), x=x)


def _sampled(
    density: HypothesisDensity,
    normal: Laplace,
    chains: int,
    draws: int,
    generator: torch.Generator,
) -> tuple[Draws | None, str]:
    """Draws of the density by SGLD or importance; None where neither can be had; and why not by SGLD."""
    surrogate, mode = fitted(density, normal, generator)
    steepness = float(stiffness(density, Coordinates.of(mode)))
    target = corrected(density, surrogate, mode, steepness, generator)
    z, why = None, "gradients jump within a posterior standard deviation"
    if target is not None:
        z, why = _walked(target, mode, steepness, chains, draws, generator)
    if z is not None and target is not None:
        x, worth = density.constrain(z), float(effective_sample_size(z).min())
        return Draws(density.names, x.numpy(), "sgld", worth), ""
    weighted = weighted_draws(target or Corrected(density, surrogate, 1, 0.0), _WEIGHED, generator=generator, mode=mode)
    worth = float(weighted.effective[0])
    if worth < _FEWEST or not float(weighted.pareto_k[0]) < reliable(len(weighted.z)):
        return None, f"{why}; importance weights are not reliable either"
    z = weighted.equal(chains * draws, generator)[:, 0].reshape(chains, draws, -1)
    return Draws(density.names, density.constrain(z).numpy(), "importance", worth, why=why), why


def fitted(density: HypothesisDensity, normal: Laplace, generator: torch.Generator) -> tuple[Surrogate, Mode]:
    """A surrogate where the density has its mass, and its mode."""
    count = 2 * terms_of(len(normal.mean)) + 8
    rng = np.random.default_rng(generator.initial_seed())
    surrogate = Surrogate.of(density, normal.draws(count, rng, widen=False, times=_WIDER))
    for _ in range(2):
        mode = find_mode(surrogate)
        if not bool(mode.converged[0]):  # far from any quadratic: Laplace's
            return surrogate, _normal_mode(density, normal)
        z = weighted_draws(surrogate, _SOUGHT, generator=generator, mode=mode).equal(count, generator)[:, 0]
        wider = z.mean(0) + _WIDER * (z - z.mean(0))
        surrogate = Surrogate.of(density, density.constrain(wider).numpy())
    mode = find_mode(surrogate, start=mode.z)
    return surrogate, mode if bool(mode.converged[0]) else _normal_mode(density, normal)


def _normal_mode(density: HypothesisDensity, normal: Laplace) -> Mode:
    z = density.unconstrain(torch.as_tensor(np.clip(normal.mean, *normal.limits.T)))
    root = torch.linalg.cholesky(torch.as_tensor(normal.covariance))
    back = torch.linalg.solve(torch.autograd.functional.jacobian(density.constrain, z), root)
    scale = torch.linalg.cholesky(back @ back.mT)
    return Mode(z[None], scale[None], torch.zeros(1, dtype=z.dtype), torch.tensor([True]))


def corrected(
    density: HypothesisDensity, surrogate: Surrogate, mode: Mode, steepness: float, generator: torch.Generator
) -> Corrected | None:
    """The density with gradients of the surrogate where they will do; None where it is too steep for SGLD.

    Noise of variance s² in whitened gradients widens a variance by `step s² / 4`, with the step that suits the
    `steepness`. Correcting one gradient in n leaves `(n - 1)` times the squared error of the surrogate, measured at
    draws like those that it was fitted to. At the limit of its reach a single correction must not displace a chain far.
    """
    size, step = mode.z.shape[-1], STEP / steepness

    def lacking(w: Tensor) -> Tensor:
        z = surrogate.middle + w @ surrogate.spread.mT
        return (density.score(z) - surrogate.score(z)) @ mode.scale[0]

    w = torch.randn(_PROBES, 1, size, dtype=mode.z.dtype, generator=generator)
    typical = float(lacking(w).square().mean(0).max())
    if not typical <= _CLIFF:  # NaN is not either
        return None
    points = min(_RAREST, 1 + 4 * _INFLATED / (step * max(typical, 1e-12)))
    unit = torch.randn(size, 1, size, dtype=mode.z.dtype, generator=generator)
    for times in _REACHES:
        reach = times * size**0.5
        farthest = float(lacking(unit * reach / unit.norm(dim=-1, keepdim=True)).abs().max())
        most = _THROWN * STEP / (step * max(farthest, 1e-12))
        if most >= points:
            break
    return Corrected(density, surrogate, int(max(1.0, min(points, most))), reach)


def _walked(
    target: Corrected, mode: Mode, steepness: float, chains: int, draws: int, generator: torch.Generator
) -> tuple[Tensor | None, str]:
    """SGLD draws of `z` (chain, draw, coordinate), or None and the reason; the number of gradients is bounded."""
    density = target.exact
    steps = min(_STEPS, _GRADIENT_STEPS / len(density.hypothesis.data.grid.time) * target.points / chains)
    each = steps / (draws + 8)  # a draw, with the burn-in
    # a direction r standard deviations of the mode wide takes r² steps, as long as the steepest one allows
    wide = torch.linalg.svdvals(torch.linalg.solve(mode.scale[0], target.surrogate.spread)).max() / _WIDER
    apart = max(1.0, float(wide) ** 2)
    if chains * draws * min(1.0, each / (steepness * apart)) < _FEWEST:
        shape = f"in places {steepness:.0f} times as steep, {float(wide):.1f} times as wide"
        return None, f"its shape is far from normal ({shape}), and SGLD would take too long"
    longest = min(max(1.0, steepness), max(1.0, each))
    thinning = max(1, round(min(apart, each / longest)))
    settings = SamplerSettings(
        chains=chains,
        draws=draws,
        burn_in=2 + 2 * thinning,
        thinning=thinning,
        step=STEP,
        spread=1.0,
        longest=longest,
        attempts=1,
        batch=1 if target.points > 1 else None,
        compare=False,  # too expensive at hundreds of points; Stein's identity below replaces it
    )
    walked = walk(target, settings, generator=generator, mode=mode)
    if not bool(walked.converged[0]):
        return None, walked.why[0]
    z = density.unconstrain(walked.draws[:, :, 0])
    worth = float(effective_sample_size(z).min())
    if not worth >= _FEWEST:
        return None, f"its chains are worth {worth:.0f} draws"
    off = stein_discrepancy(density, mode, z, generator)
    if off > 0:
        return None, f"by Stein's identity a variance of its draws is off by {off:.2g}"
    return z, ""


def stein_discrepancy(density: HypothesisDensity, mode: Mode, z: Tensor, generator: torch.Generator) -> float:
    """Largest violation of Stein's identity by draws `z` (chain, draw, coordinate); 0 where it is not significant.

    Under the density the mean of `(w - mean) dU/dw` is 1 for each coordinate. A share of the variance and three
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


# Laplace's approximation ----------------------------------------------------------------------------------------------
@dataclass(frozen=True, eq=False)
class Laplace:
    """Laplace's approximation of the tempered density at a hypothesis, in its coordinates `names`.

    `mean` (coordinate,), which may lie beyond `limits` (coordinate, 2); `covariance` (coordinate, coordinate) of the
    density alone; `stretch`: the linear map of deviations that makes it the widened one.
    """

    names: tuple[str, ...]
    mean: FloatArray
    covariance: FloatArray
    stretch: FloatArray
    limits: FloatArray

    @classmethod
    def of(cls, h: Hypothesis, names: Sequence[str] | None = None, temper: float = TEMPER) -> Laplace:
        """At an evaluated hypothesis; `names`: default those of `moving`."""
        names = moving(h) if names is None else list(names)
        data = h.data
        W = whitened_jacobian(h, jacobian(h, names))
        if h.force is not None:  # what a force map can do as well tells nothing: its coefficients are integrated out
            X = whitened_jacobian(h, force_columns(h))
            own: FloatArray = X @ X.T + np.eye(len(X)) / (temper * h.force.size**2)
            W = W - (W @ X.T) @ np.linalg.solve(own, X)
        A: FloatArray = temper * W @ W.T + np.diag(prior_terms(h, names)[0])
        root = _covariance_root(np.asarray(np.linalg.inv(A), np.float64))
        residual = whiten(data, h.covariance, h.residual)
        each = (W * residual).reshape(len(names), data.channel_count, data.frame_count, -1).sum((1, 3))
        x = torch.as_tensor(h.values[[INDEX[n] for n in names]]).requires_grad_()
        (slope,) = torch.autograd.grad(log_prior(h, names, x), x)
        covariance = root @ root.T
        mean = x.detach().numpy() + covariance @ (temper * each.sum(1) + slope.numpy())
        stretch = np.eye(len(names))
        for scatter in (_of_frames(each), _of_halves(each)):
            now = stretch @ root
            size, basis = np.linalg.eigh(temper**2 * now.T @ scatter @ now)
            # in whitened coordinates: what scatters less than the density's unit variance stays
            wider = basis * np.sqrt(np.maximum(size, 1.0)) @ basis.T
            stretch = now @ wider @ np.linalg.inv(root)
        limits = np.array([support(h, n) for n in names])
        return cls(tuple(names), mean, covariance, stretch, limits)

    @cached_property
    def widened(self) -> FloatArray:
        """Covariance (coordinate, coordinate) that covers the scatter of the drive's parts."""
        return self.stretch @ self.covariance @ self.stretch.T

    def draws(self, count: int, rng: np.random.Generator, *, widen: bool = True, times: float = 1.0) -> FloatArray:
        """Draws (draw, coordinate) within the limits, of `times` the standard deviation."""
        return truncated_normal(
            self.mean, times**2 * (self.widened if widen else self.covariance), self.limits, count, rng
        )

    def stretched(self, x: FloatArray) -> FloatArray:
        """Draws (..., coordinate) of the density made as wide as the widened covariance, reflected at the limits."""
        mean = x.reshape(-1, x.shape[-1]).mean(0)
        return reflected(mean + (x - mean) @ self.stretch.T, self.limits)


def moving(h: Hypothesis) -> list[str]:
    """Free coordinates but those that stand at a limit and make no difference there, as a saturation out of reach."""
    ends = [n for n in h.free if h[n] in h.limits(n)]
    idle = {n for n, d in zip(ends, jacobian(h, ends), strict=True) if not d.any()} if ends else set()
    return [n for n in h.free if n not in idle]


def truncated_normal(
    mean: FloatArray, covariance: FloatArray, limits: FloatArray, count: int, rng: np.random.Generator
) -> FloatArray:
    """Draws (draw, coordinate) of a normal within a box `limits` (coordinate, 2).

    Those inside are kept; where they are too few, Gibbs' sampler takes the coordinates one by one (Geweke 1991).
    """
    low, high = limits.T
    x = mean + rng.standard_normal((_TRIED_DRAWS * count, len(mean))) @ _covariance_root(covariance).T
    inside = x[((x >= low) & (x <= high)).all(1)]
    if len(inside) >= count:
        return inside[:count]
    x = np.clip(x[:count], low, high)
    precision = np.linalg.inv(covariance)
    for _ in range(_GIBBS_SWEEPS):
        for k, own in enumerate(np.sqrt(np.diag(precision))):
            centre = x[:, k] - (x - mean) @ precision[k] / own**2
            a, b = own * (low[k] - centre), own * (high[k] - centre)
            side = np.where(a > -b, -1.0, 1.0)  # in the lower tail, where probabilities keep their digits
            a, b = np.where(side < 0, -b, a), np.where(side < 0, -a, b)
            share = ndtr(a) + rng.random(count) * (ndtr(b) - ndtr(a))
            x[:, k] = np.clip(centre + side * np.clip(ndtri(share), a, b) / own, low[k], high[k])
    return x


def reflected(x: FloatArray, limits: FloatArray) -> FloatArray:
    """`x` (..., coordinate) folded back at `limits` (coordinate, 2) as often as it takes."""
    low, span = limits[:, 0], np.diff(limits)[:, 0]
    with np.errstate(invalid="ignore"):
        away = np.mod(x - low, 2 * span)
        folded = low + np.minimum(away, 2 * span - away)
    return np.where(np.isfinite(span), folded, x)


def _of_frames(scores: FloatArray) -> FloatArray:
    """Covariance of the total score from scores (coordinate, frame) that neighbours share."""
    s, F = scores - scores.mean(1, keepdims=True), scores.shape[1]
    lags = min(int(4 * (F / 100) ** (2 / 9)), F - 1)
    J = s @ s.T
    for lag in range(1, lags + 1):
        cross = s[:, lag:] @ s[:, :-lag].T
        J += (1 - lag / (lags + 1)) * (cross + cross.T)
    return J * F / max(F - 1, 1)


def _of_halves(scores: FloatArray) -> FloatArray:
    """The same from the difference of two halves, which knows one direction only."""
    half = scores.shape[1] // 2
    apart = scores[:, :half].sum(1) - scores[:, half:].sum(1)
    return np.outer(apart, apart)


def _covariance_root(covariance: FloatArray) -> FloatArray:
    """A root of a covariance, also where rounding made it indefinite."""
    size, basis = np.linalg.eigh(0.5 * (covariance + covariance.T))
    return basis * np.sqrt(np.maximum(size, 1e-18 * size.max()))
