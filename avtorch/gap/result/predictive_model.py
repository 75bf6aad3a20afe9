"""A model of the alias set, with all that is needed to predict another drive of the same car."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from avtorch.arrays import FloatArray
from avtorch.gap.answer.verdict import Verdict
from avtorch.gap.likelihood.noise_model import NoiseModel
from avtorch.gap.posterior.summary import belief
from avtorch.gap.search.fitted_model import FittedModel, SearchResult
from avtorch.gap.simulator.plant import GapPlant

_DRAWS = 64
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
    def of(cls, found: FittedModel) -> PredictiveModel:
        """The predictive model of a fitted one."""
        record = found.hypothesis.record
        grade = found.grade_rms if found.hypothesis.integrated is not None else None
        return cls(
            name=found.name,
            plant=found.hypothesis.plant,
            belief=belief(found, count=_DRAWS),
            noise=found.noise.noise,
            grade_rms=grade,
            specific_force=record.accel_kind == "specific-force",
        )


def predictive_models(race: SearchResult, verdict: Verdict) -> tuple[PredictiveModel, ...]:
    """Models of the verdict's alias set, as far as its members were fitted, the verdict first; at most five.

    `unknown` makes no predictions: where it leaves fewer than two models, the named ones with the most evidence are
    added, because an experiment that distinguishes these tests the car for all that they represent.
    """
    by_name: Mapping[str, FittedModel] = {f.name: f for f in race.found}
    names: Sequence[str] = [n for n in verdict.alias_set if n in by_name]
    if (len(names) < 2 and len(verdict.alias_set) > 1) or verdict.abstained:
        others = [f.name for f in race.found if f.name not in names]
        # models that differ only in a random effect predict the same
        names = _apart([by_name[name] for name in [*names, *others]])[: len(names) + _STAND_IN]
    return tuple(PredictiveModel.of(by_name[name]) for name in names[:MOST_MODELS])


def _apart(found: Sequence[FittedModel]) -> list[str]:
    """Names of the models whose rollouts differ from those of every earlier one."""
    out: dict[frozenset[str], str] = {}
    for f in found:
        out.setdefault(frozenset(e.name for e in f.hypothesis.effects), f.name)
    return list(out.values())
