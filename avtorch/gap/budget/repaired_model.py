"""The car with all parts of a budget: its parameters with intervals, and the simulator that holds them.

What the folds disagree on is the uncertainty (a jackknife): it counts what differs from one stretch of driving to
another, where a posterior of misspecified equations does not. What all folds err in alike is added for the size of an
effect, as the equation of the table is not quite the car's.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from scipy.stats import t as student  # pyright: ignore[reportMissingTypeStubs]
from torch import Tensor

from avtorch.arrays import FloatArray
from avtorch.gap.answer.budget import Budget
from avtorch.gap.budget.analysis_record import AnalysisRecord
from avtorch.gap.budget.robust_fit import Fit
from avtorch.gap.budget.selection_step import Selection, Step
from avtorch.gap.likelihood.noise_model import NoiseModel
from avtorch.gap.quantity import Quantity
from avtorch.gap.simulator.effect import Effect
from avtorch.gap.simulator.integrated import Integrated
from avtorch.gap.simulator.plant import GapPlant, plant

SHAPE = 0.03
"""Standard deviation of an effect's fitted over its true distance from no effect, beyond what folds disagree on.

The likeliest of 0.01 to 0.1 for 54 parts of drives of the reference vehicle, whose equations are not the table's,
behind ordinary recorders; 0.02 is as likely. Without it 90 % intervals held 63 % of these sizes.
"""


def parameters_of(selection: Selection, name: str) -> dict[str, Quantity]:
    """The parameters of one effect under the answer's names."""
    model, every = selection.sized.fit.model, _folds(selection)
    plants = model.plant.with_values(model.values(every))
    effect = next(e for e in plants.effects if e.name == name)
    reported = effect.report(torch.as_tensor(plants.T_L))
    if isinstance(effect, Integrated):  # whose fit leaves the size at its default, and has it in the coefficients
        reported = {**reported, effect.size: effect.size_along(places(model.record))}
    out = {}
    for key, value in reported.items():
        x = np.broadcast_to(value.numpy(), (len(every),) if value.dim() < 2 else value.shape)
        if x.ndim == 1:
            out[key] = _jackknife(x, SHAPE * _distance(effect, key, float(x[0])))
    return out


def _distance(effect: Effect, key: str, value: float) -> float:
    """Of a parameter's value from no effect, or from 0 where that is at infinity; 0 of one that is no size."""
    if key not in {p.name for p in effect.parameters}:
        return abs(value)
    neutral = next(p.neutral for p in effect.parameters if p.name == key)
    if neutral is None:
        return 0.0
    return abs(value - neutral) if np.isfinite(neutral) else abs(value)


def places(record: AnalysisRecord) -> Tensor:
    """Positions (row,) [m] of all rows."""
    return torch.cat([s.drive.position for s in record.stretches if s.drive.position is not None])


def lag_and_gain(selection: Selection) -> dict[str, Quantity]:
    """`T_L` [s] and `K_L` [-], fitted together with all parts."""
    values = selection.sized.fit.model.values(_folds(selection))
    return {key: _jackknife(values[key].numpy()) for key in ("T_L", "K_L")}


def repaired_plant(selection: Selection, base: GapPlant) -> GapPlant:
    """The simulator with all parts, from the start of a drive even where the car has them from an onset."""
    return plant_of(selection.sized.fit, base)


def with_chance(car: GapPlant, budget: Budget, kinds: Sequence[type[Effect]], noise: NoiseModel) -> GapPlant:
    """The `car` with those of `kinds` that chance decides and the budget names, and with jerk noise besides.

    `noise`: what is left with all parts, a slow force apart. Rollouts are the same: they are free of noise.
    """
    known = {kind.name: kind for kind in kinds}
    named = [part for part in budget.chance if part.name in budget.names and part.name in known and part.parameters]
    effects = [
        known[part.name].of({key: q.mean for key, q in (part.parameters or {}).items()}).in_noise(noise.accel_sd)
        for part in named
    ]
    return plant(effects, baseline=car, sigma=noise.jerk_sd)


def plant_of(fit: Fit, base: GapPlant) -> GapPlant:
    """`base` with the effects, lag and gain of a fit."""
    model = fit.model
    values = {key: x if x.dim() else float(x) for key, x in model.values(fit.z).items()}
    filled = model.plant.with_values(values)
    own = set(model.names)
    effects: Sequence[Effect] = [e for e in filled.effects if e.name in own]
    return plant(effects, baseline=base, T_L=float(filled.T_L), K_L=float(filled.K_L))


def parameter_draws(selection: Selection, *, count: int = 64, seed: int = 0) -> dict[str, FloatArray]:
    """Draws (draw,) of the repaired simulator's parameters."""
    return draws_of(selection.sized, count=count, seed=seed)


def draws_of(step: Step, *, count: int = 64, seed: int = 0) -> dict[str, FloatArray]:
    """Draws (draw,) of the parameters of a model, normal with the folds' covariance."""
    model, z, folds = step.fit.model, step.fit.z, step.held.z
    away = (folds - folds.mean(0)) * np.sqrt((len(folds) - 1) / len(folds))
    normal = np.random.default_rng(seed).standard_normal((count, len(folds)))
    values = model.values(z + normal @ away)
    return {key: x.numpy() for key, x in values.items() if x.dim() == 1}


def _folds(selection: Selection) -> FloatArray:
    """(1 + fold, size): all blocks, then without each fold."""
    return np.concatenate([selection.sized.fit.z[None], selection.sized.held.z])


def _jackknife(x: FloatArray, common: float = 0.0) -> Quantity:
    """Of values with all blocks, then without each fold; `common`: standard deviation of what all of them err in."""
    count = len(x) - 1
    half = float(student.ppf(0.95, count - 1))  # pyright: ignore[reportUnknownMemberType]
    sd = float(np.hypot(np.sqrt((count - 1) / count * ((x[1:] - x[1:].mean()) ** 2).sum()), common))
    return Quantity(float(x[0]), sd, float(x[0] - half * sd), float(x[0] + half * sd))
