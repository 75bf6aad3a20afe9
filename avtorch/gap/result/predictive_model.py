"""A model of the alias set, with all that is needed to predict another drive of the same car."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from avtorch.arrays import FloatArray
from avtorch.gap.answer.verdict import Verdict
from avtorch.gap.engine.average import Weight
from avtorch.gap.likelihood.noise_model import NoiseModel
from avtorch.gap.result.parameters import ParameterPosterior
from avtorch.gap.simulator.plant import GapPlant
from avtorch.io.units import GRAVITY

_DRAWS = 64
_FAST_HZ = 2.0  # above it the sensors' own noise is what is left
MOST_MODELS = 5
"""That an experiment is asked to tell apart."""
_STAND_IN = 3


@dataclass(frozen=True, eq=False)
class PredictiveModel:
    """`plant` with the settings taken from the log; `belief`: draws (draw,) of its parameters by its own names.

    `noise`: of single rows of the log. `grade_rms`: size of an unknown road grade, None where the model has none.
    `specific_force`: whether the log's `accel` is an accelerometer's reading. `probability`: relative to the other
    models; None: that of the hypothesis of this name.
    """

    name: str
    plant: GapPlant = field(repr=False)
    belief: Mapping[str, FloatArray] = field(repr=False)
    noise: NoiseModel
    grade_rms: float | None = None
    specific_force: bool = False
    probability: float | None = None

    @classmethod
    def of(cls, posterior: ParameterPosterior, baseline: GapPlant | None) -> PredictiveModel:
        """The predictive model of a weight of the model average."""
        weight = posterior.weight
        noise = noise_of(weight)
        grade = weight.composition.slow.road_sd / GRAVITY if weight.slow == "road_grade" else None
        return cls(
            name=weight.label,
            plant=posterior.plant(baseline, noise.jerk_sd),
            belief=posterior.belief(_DRAWS),
            noise=noise,
            grade_rms=grade,
            specific_force=weight.examined.hypothesis.data.accel_kind == "specific-force",
        )


def predictive_models(
    posteriors: Mapping[str, ParameterPosterior], verdict: Verdict, baseline: GapPlant | None
) -> tuple[PredictiveModel, ...]:
    """Models of the verdict's alias set, the verdict first; at most five.

    `unknown` makes no predictions: where it leaves fewer than two models, the named ones of most weight are added,
    because an experiment that distinguishes these tests the car for all that they represent.
    """
    names: Sequence[str] = [n for n in verdict.alias_set if n in posteriors]
    if (len(names) < 2 and len(verdict.alias_set) > 1) or verdict.abstained:
        others = [n for n in posteriors if n not in names]
        # models that differ only in a random effect predict the same
        names = _apart([posteriors[n] for n in [*names, *others]])[: len(names) + _STAND_IN]
    return tuple(PredictiveModel.of(posteriors[n], baseline) for n in names[:MOST_MODELS])


def noise_of(weight: Weight) -> NoiseModel:
    """The noise of single rows, from the spectrum beside a weight's hypothesis and its slow forces."""
    h, slow = weight.examined.hypothesis, weight.composition.slow
    data, S = h.data, h.covariance
    middle = np.add.reduceat(data.frequency, data.band_edges[:-1]) / np.diff(data.band_edges)
    fast = middle > min(_FAST_HZ, 0.5 * float(middle[-1]))
    out = NoiseModel(process_sd=slow.process_noise * math.sqrt(h["T_L"] / 2), process_time=h["T_L"])
    if weight.slow == "gust":
        out = out.replaced(force_sd=slow.gust_sd, force_time=slow.gust_time)
    if data.accel is not None:
        out = out.replaced(accel_sd=float(np.sqrt(S[fast, 0, 0].min())))
    if data.speed is not None:
        differenced = np.sin(2 * np.pi * middle[fast] * data.dt) ** 2 / data.dt**2  # gain of the central difference
        out = out.replaced(speed_sd=float(np.sqrt((S[fast, -1, -1] / np.maximum(differenced, 1e-3)).min())))
    return out


def _apart(posteriors: Sequence[ParameterPosterior]) -> list[str]:
    """Names of the models whose rollouts differ from those of every earlier one."""
    out: dict[frozenset[str], str] = {}
    for p in posteriors:
        out.setdefault(frozenset(p.effects), p.weight.label)
    return list(out.values())
