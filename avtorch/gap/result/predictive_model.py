"""A model of the alias set, with all that is needed to predict another drive of the same car."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from avtorch.arrays import FloatArray
from avtorch.gap.answer.verdict import Verdict
from avtorch.gap.result.noise_spectrum import NoiseSpectrum
from avtorch.gap.result.parameters import ParameterPosterior
from avtorch.gap.simulator.plant import GapPlant
from avtorch.io.units import GRAVITY

_DRAWS = 64
MOST_MODELS = 5
"""That an experiment is asked to tell apart."""
_STAND_IN = 3


@dataclass(frozen=True, eq=False)
class PredictiveModel:
    """`plant` with the settings taken from the log; `belief`: draws (draw,) of its parameters by its own names.

    `noise`: of the log. `grade_rms`: size of an unknown road grade, None where the model has none.
    `specific_force`: whether the log's `accel` is an accelerometer's reading. `probability`: relative to the other
    models; None: that of the hypothesis of this name.
    """

    name: str
    plant: GapPlant = field(repr=False)
    belief: Mapping[str, FloatArray] = field(repr=False)
    noise: NoiseSpectrum = field(repr=False)
    grade_rms: float | None = None
    specific_force: bool = False
    probability: float | None = None

    @classmethod
    def of(cls, posterior: ParameterPosterior, baseline: GapPlant | None, noise: NoiseSpectrum) -> PredictiveModel:
        """The predictive model of a weight of the model average."""
        weight = posterior.weight
        grade = weight.composition.slow.road_sd / GRAVITY if "road_grade" in posterior.names else None
        return cls(
            name=weight.label,
            plant=posterior.plant(baseline, weight.process_noise),
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
    because an experiment that distinguishes these tests the car for all that they represent. All have the noise that
    the first one leaves: a difference of levels would tell models apart in any drive, whatever it is made of.
    """
    names: Sequence[str] = [n for n in verdict.alias_set if n in posteriors]
    if (len(names) < 2 and len(verdict.alias_set) > 1) or verdict.abstained:
        others = [n for n in posteriors if n not in names]
        # models that differ only in a random effect predict the same
        names = _apart([posteriors[n] for n in [*names, *others]])[: len(names) + _STAND_IN]
    if not names:
        return ()
    noise = NoiseSpectrum.of(posteriors[names[0]].weight.examined.hypothesis)
    return tuple(PredictiveModel.of(posteriors[n], baseline, noise) for n in names[:MOST_MODELS])


def _apart(posteriors: Sequence[ParameterPosterior]) -> list[str]:
    """Names of the models whose rollouts differ from those of every earlier one."""
    out: dict[frozenset[str], str] = {}
    for p in posteriors:
        out.setdefault(frozenset(p.effects), p.weight.label)
    return list(out.values())
