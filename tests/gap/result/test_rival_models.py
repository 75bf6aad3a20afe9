"""What the next experiment tells apart where held-out blocks selected several effects."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from avtorch import diagnose
from avtorch.experiment import next_experiment
from avtorch.gap import EFFECTS, Budget, ConstantResistance, SensorBias, plant
from avtorch.gap.answer.verdict import Candidate, Verdict
from avtorch.gap.budget.analysis_record import AnalysisRecord
from avtorch.gap.budget.forward_selection import baseline_noise
from avtorch.gap.budget.gap_budget import budget_of
from avtorch.gap.budget.given_effects import given_effects
from avtorch.gap.budget.repaired_model import repaired_plant
from avtorch.gap.budget.selection_step import Selection
from avtorch.gap.likelihood.noise_model import NoiseModel
from avtorch.gap.result.diagnosis import Diagnosis
from avtorch.gap.result.predictive_model import PredictiveModel
from avtorch.gap.result.rival_models import rival_models
from tests.gap.budget.cars import log_of

BASE = plant([])
NAMES = ("constant_resistance", "sensor_bias")
BOTH = "constant_resistance+sensor_bias"
NOISE = NoiseModel(process_sd=0.04, accel_sd=0.06, speed_sd=0.03)


@pytest.fixture(scope="module")
def selected() -> tuple[Selection, Budget]:
    log = log_of([ConstantResistance(0.12), SensorBias(0.2)], seconds=100.0, seed=3)
    fitting, bare = baseline_noise(AnalysisRecord.for_budget([log]), BASE)
    selection = given_effects(fitting, bare, [EFFECTS[name] for name in NAMES], values={}, onsets={})
    return selection, budget_of(selection)


def rivals(
    selected: tuple[Selection, Budget], sure: dict[str, float], aliases: dict[str, tuple[str, ...]], *beside: str
) -> dict[str, PredictiveModel]:
    """Of a verdict of both effects, with these probabilities and aliases of the parts; `beside` in its alias set."""
    selection, budget = selected
    parts = tuple(
        replace(p, probability=sure[p.name], alias_set=(p.name, *aliases.get(p.name, ()))) for p in budget.parts
    )
    verdict = Verdict(NAMES, (BOTH, *beside), abstained=False, why="")
    made = rival_models(selection, replace(budget, parts=parts), verdict, BASE, [], noise=NOISE, probability=0.8)
    return {model.name: model for model in made}


def test_the_first_is_the_repaired_simulator(selected: tuple[Selection, Budget]) -> None:
    models = rivals(selected, dict.fromkeys(NAMES, 0.99), {})
    assert list(models) == [BOTH]
    expected = repaired_plant(selected[0], BASE).values()
    assert {k: float(x) for k, x in models[BOTH].plant.values().items()} == {k: float(x) for k, x in expected.items()}
    for key, draws in models[BOTH].belief.items():
        assert np.mean(draws) == pytest.approx(float(expected[key]), abs=4 * float(np.std(draws)) + 1e-9)


def test_an_alias_takes_the_place_of_its_part_alone(selected: tuple[Selection, Budget]) -> None:
    other = "aerodynamic_drag+sensor_bias"
    aliases = {"constant_resistance": ("aerodynamic_drag",)}
    models = rivals(selected, dict.fromkeys(NAMES, 0.99), aliases, other)
    assert list(models) == [BOTH, other]
    assert [e.name for e in models[other].plant.effects] == ["aerodynamic_drag", "sensor_bias"]
    # fitted anew: a force of the size that the resistance had, 0.12 m/s², less what slow noise makes of it
    drag = models[other].plant.report()["aerodynamic_drag"]["drag_per_m"]
    assert 0.03 < float(drag) * 18.0**2 < 0.25
    assert models[other].probability == models[BOTH].probability == 0.8


def test_the_least_certain_part_is_left_out_where_it_is_not_sure(selected: tuple[Selection, Budget]) -> None:
    models = rivals(selected, {"constant_resistance": 0.99, "sensor_bias": 0.8}, {})
    assert list(models) == [BOTH, "constant_resistance"]
    assert models["constant_resistance"].probability == pytest.approx(0.8 * 0.25)
    assert [e.name for e in models["constant_resistance"].plant.effects] == ["constant_resistance"]
    assert "sensor_bias.bias_mps2" not in models["constant_resistance"].belief


def test_what_the_signals_do_not_show_is_left_out(selected: tuple[Selection, Budget]) -> None:
    models = rivals(selected, dict.fromkeys(NAMES, 0.99), {}, "constant_resistance+outliers", "unknown")
    assert list(models) == [BOTH]


def test_a_slope_that_stands_in_for_a_resistance_is_of_another_road(selected: tuple[Selection, Budget]) -> None:
    models = rivals(selected, dict.fromkeys(NAMES, 0.99), {}, "road_grade+sensor_bias")
    road = models["road_grade+sensor_bias"]
    assert road.grade_rms is not None
    assert road.grade_rms >= 0.03
    assert all(getattr(e, "profile", None) is None for e in road.plant.effects)
    assert not any("profile" in key for key in road.belief)


@pytest.mark.slow
def test_a_manoeuvre_tells_the_sets_apart(selected: tuple[Selection, Budget]) -> None:
    sure, other = {"constant_resistance": 0.99, "sensor_bias": 0.8}, "aerodynamic_drag+sensor_bias"
    models = rivals(selected, sure, {"constant_resistance": ("aerodynamic_drag",)}, other)
    log = log_of(seconds=30.0)
    found = diagnose(log, effects=["sensor_bias"], pairs=False)
    each = [Candidate(BOTH, 0.8, None), *(c for c in found.candidates if c.name in ("none", "unknown"))]
    asked: Diagnosis = replace(
        found,
        candidates=tuple(each),
        verdict=Verdict(NAMES, (BOTH, other), abstained=False, why=""),
        contenders=tuple(models.values()),
        budget=None,
    )
    experiment = next_experiment(asked)
    assert experiment is not None
    assert experiment.separates == (BOTH, other, "constant_resistance")
    assert experiment.information.nats > 0.5 * experiment.entropy > 0.3


@pytest.mark.slow
def test_an_answer_by_held_out_blocks_has_them() -> None:
    """A resistance that a slope of the road could be as well, and a bias, behind sensors with coloured noise."""
    log = log_of([ConstantResistance(0.25), SensorBias(0.2)], seconds=100.0, seed=3)
    found = diagnose(log, effects=[*NAMES, "road_grade"], posterior="laplace")
    assert set(found.verdict.names) == set(NAMES)
    assert found.plant is not None
    first, *others = found.contenders
    assert first.name == BOTH == found.verdict.name
    assert [e.name for e in first.plant.effects] == [e.name for e in found.plant.effects]
    assert {model.name for model in others} >= {x for x in found.verdict.alias_set if x not in (BOTH, "unknown")}
