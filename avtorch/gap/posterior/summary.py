"""Parameters of a fitted model under the answer's names, with uncertainty, and the repaired simulator."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TypeVar

import numpy as np
import torch
from torch import Tensor

from avtorch.arrays import FloatArray
from avtorch.gap.likelihood.hypothesis import Coordinate
from avtorch.gap.posterior.density import RolloutDensity, root
from avtorch.gap.posterior.draws import Draws
from avtorch.gap.quantity import Quantity
from avtorch.gap.search.fitted_model import FittedModel
from avtorch.gap.simulator.effect import Effect
from avtorch.gap.simulator.integrated import Integrated
from avtorch.gap.simulator.plant import GapPlant, plant

Link = Callable[[Tensor], Tensor]
T = TypeVar("T")

_LAPLACE = 2000  # draws from Laplace's approximation where no draws are given


def reported(found: FittedModel, draws: Draws | None = None) -> dict[str, Quantity]:
    """Parameters of the model's effects by the table's names, those of a pair as `effect.parameter`.

    From `draws` of the posterior, or else from Laplace's approximation at the mode. Parameters of random effects are
    normal on their link's scale, as estimated by their own fits.
    """
    deterministic = {name: Quantity.of_draws(x) for name, x in _deterministic(found, draws).items()}
    normal = {name: Quantity.of_normal(*law) for name, law in _random(found).items()}
    return _named(found, deterministic | normal)


def lag_and_gain(found: FittedModel, draws: Draws | None = None) -> dict[str, Quantity]:
    """The baseline's `T_L` [s] and `K_L` [-], fitted together with the model's effects."""
    values = _values(found, draws)
    return {name: Quantity.of_draws(values[name]) for name in ("T_L", "K_L")}


def belief(found: FittedModel, draws: Draws | None = None, *, count: int = 64) -> dict[str, FloatArray]:
    """Draws (draw,) of the repaired simulator's parameters, by its own names."""
    values = {key: x.reshape(-1) for key, x in _values(found, draws).items()}
    every = max(1, len(values["T_L"]) // count)
    return {key: x[::every][:count] for key, x in values.items()}


def reported_draws(found: FittedModel, draws: Draws) -> dict[str, FloatArray]:
    """Draws (chain, draw) under the names of `reported`, `T_L` and `K_L` first."""
    rng = np.random.default_rng(0)
    shape = draws.z.shape[:2]
    random = {}
    for name, (mean, sd, link) in _random(found).items():
        random[name] = link(torch.as_tensor(mean + sd * rng.standard_normal(shape))).numpy()
    base = {name: draws.values[name] for name in ("T_L", "K_L")}
    return base | _named(found, _deterministic(found, draws) | random)


def repaired(found: FittedModel, baseline: GapPlant | None = None, draws: Draws | None = None) -> GapPlant:
    """The simulator with the model's effects, at the posterior mean of each parameter, with the fitted jerk noise.

    `baseline`: the plant whose effects are kept; the model's own by default. Effects act from the start of a drive,
    even where the model has an onset. The road grade is the one estimated for the first drive.
    """
    means = {key: float(x.mean()) for key, x in _values(found, draws).items()}
    noise = found.noise.noise
    filled = found.hypothesis.plant.with_values(means)
    own = {kind.name for kind in found.hypothesis.effects}
    effects: list[Effect] = [_plain(e) for e in filled.effects if e.name in own]
    for i, effect in enumerate(effects):
        if isinstance(effect, Integrated) and found.profile is not None:
            rms = _deterministic(found, draws).get(f"{effect.name}.{effect.size}")
            size = float(rms.mean()) if rms is not None else float(found.grade_rms or 1.0)
            effects[i] = effect.along(torch.as_tensor(np.asarray(found.profile[: effect.count])), size)
    random_means = {name: float(Quantity.of_normal(*law).mean) for name, law in _random(found).items()}
    chance: list[Effect] = [kind() for kind in found.searched]
    if found.by_chance is not None:
        chance.append(found.by_chance.law.at(found.by_chance.z))
    for effect in chance:
        given = {key.partition(".")[2]: x for key, x in random_means.items() if key.startswith(f"{effect.name}.")}
        effects.append(_plain(effect.replaced(given).in_noise(float(noise.accel_sd))))
    if found.by_chance is not None and found.by_chance.process_sd is not None:
        noise = noise.replaced(process_sd=found.by_chance.process_sd)
    return plant(
        effects,
        baseline=found.hypothesis.baseline if baseline is None else baseline,
        T_L=means["T_L"],
        K_L=means["K_L"],
        sigma=noise.jerk_sd,
    )


def _values(found: FittedModel, draws: Draws | None) -> dict[str, FloatArray]:
    """Coordinates' values by key: (chain, draw), or (draw,) from Laplace's approximation."""
    if draws is not None:
        rests = {c.key for c in found.hypothesis.coordinates if c.parameter.of_onset and found.onset is None}
        centre = found.hypothesis.values(np.zeros((1, len(found.z))))
        return {k: np.full_like(x, float(centre[k])) if k in rests else x for k, x in draws.values.items()}
    rng = np.random.default_rng(0)
    noise = rng.standard_normal((_LAPLACE, len(found.z)))
    if found.delays is None:
        z = found.z + noise @ root(found.covariance).numpy().T
    else:  # draws from each mode in proportion to its share
        mode = rng.choice(len(found.delays.shares), _LAPLACE, p=found.delays.shares / found.delays.shares.sum())
        roots = np.stack([root(c).numpy() for c in found.delays.covariances])
        z = found.delays.z[mode] + np.einsum("dij,dj->di", roots[mode], noise)
    z = np.clip(z, -8.0, 8.0)
    return {key: x.numpy() for key, x in found.hypothesis.values(found.hypothesis.held(z, found.onset)).items()}


def _deterministic(found: FittedModel, draws: Draws | None) -> dict[str, FloatArray]:
    """Draws by `effect.parameter`."""
    values = _values(found, draws)
    tensors = {key: torch.as_tensor(x) for key, x in values.items()}
    report = found.hypothesis.plant.with_values(tensors).report()
    out = {}
    shape = next(iter(values.values())).shape
    for kind in found.hypothesis.effects:
        for key, x in report[kind.name].items():
            out[f"{kind.name}.{key}"] = x.expand(shape).numpy()
    integrated = found.hypothesis.integrated
    if integrated is not None:
        rms = None if draws is None else draws.grade_rms
        if rms is None:
            rms = _grade_rms(found)
        if rms is not None:
            out[f"{integrated.name}.{integrated.size}"] = rms
    return out


def _grade_rms(found: FittedModel) -> FloatArray | None:
    """Draws of the road grade's root mean square, at the mode of the other parameters."""
    density = RolloutDensity.of(found)
    slope = density.slope
    if slope is None:
        return None
    match = density.images(torch.as_tensor(found.z)[None]) @ slope.image.T
    return found.hypothesis.grade_along(slope.sampled(np.repeat(match, _LAPLACE, 0), np.random.default_rng(0)))


def _random(found: FittedModel) -> dict[str, tuple[float, float, Link]]:
    """Mean, sd and link of the random effects' parameters, by `effect.parameter`."""
    out: dict[str, tuple[float, float, Link]] = {}
    for kind in found.searched:
        estimates = _searched(found, kind)
        out |= {f"{kind.name}.{parameter}": estimates[own] for own, parameter in kind.noise_parameters.items()}
    if found.by_chance is not None:
        law, sds = found.by_chance.law, np.sqrt(np.diag(found.by_chance.covariance))
        for c, z, sd in zip(law.coordinates, found.by_chance.z.tolist(), sds.tolist(), strict=True):
            if c.parameter.reported:
                out[c.key] = (z, sd, partial(_valued, c))
    return out


def _searched(found: FittedModel, kind: type[Effect]) -> dict[str, tuple[float, float, Link]]:
    """The same for the result of an effect's own search, by the names in its `noise_parameters`."""
    form = kind.own_search()
    if form == "force":
        noise, sds = found.noise.noise, found.noise.sds
        return {
            name: (float(np.log(getattr(noise, name))), sds[name], torch.exp) for name in ("force_sd", "force_time")
        }
    if form == "tails" and found.tails is not None:
        fraction = float(np.log(max(found.tails.fraction, 1e-9)))
        return {
            "tail_fraction": (fraction, found.tails.sds[0], lambda x: x.exp().clamp_max(0.5)),
            "tail_scale": (float(np.log(found.tails.scale)), found.tails.sds[1], torch.exp),
        }
    assert found.losses is not None
    p = float(np.clip(found.losses.fraction, 1e-6, 1 - 1e-6))
    return {"loss": (float(np.log(p / (1 - p))), found.losses.sd, torch.sigmoid)}


def _valued(coordinate: Coordinate, z: Tensor) -> Tensor:
    return coordinate.parameter.constrain(coordinate.wider * z)


def _named(found: FittedModel, by_effect: dict[str, T]) -> dict[str, T]:
    """The values under the answer's keys: without the effect's name where there is only one effect."""
    pair = len(found.name.split("+")) > 1
    return {key if pair else key.partition(".")[2]: x for key, x in by_effect.items()}


def _plain(effect: Effect) -> Effect:
    """The effect with single-number tensors as numbers, for text output."""
    values = {key: float(x) for key, x in effect.values().items() if x.dim() == 0}
    return effect.replaced(values)
