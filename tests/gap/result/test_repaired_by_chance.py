"""The repaired simulator after a selection on held-out blocks has what chance decides, too."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from avtorch import diagnose
from avtorch.gap import Effect, Gust, SensorBias, plant
from avtorch.gap.answer.budget import Budget, ChancePart, Unexplained
from avtorch.gap.budget.repaired_model import with_chance
from avtorch.gap.effects import Outliers
from avtorch.gap.likelihood.noise_model import NoiseModel
from avtorch.gap.quantity import Quantity
from avtorch.gap.result.diagnosis import Diagnosis
from avtorch.gap.simulator.plant import GapPlant
from tests.gap.budget.cars import DT, log_of
from tests.gap.budget.test_slow_disturbance import coloured

SD, TIME_S = 0.3, 3.0
KINDS = ["sensor_bias", "dead_time", "gust"]


def pushed(effects: list[Effect]) -> Diagnosis:
    """A car with `effects` that wind pushes, behind sensors with coloured noise."""
    log = log_of(effects, seed=2)
    assert log.accel is not None
    assert log.speed is not None
    force = coloured(np.random.default_rng(2), log.rows, SD, TIME_S, DT)
    windy = replace(log, accel=log.accel + force, speed=log.speed + np.cumsum(force) * DT)
    return diagnose(windy, effects=KINDS, posterior="laplace")


@pytest.fixture(scope="module")
def both() -> Diagnosis:
    return pushed([SensorBias(0.5)])


def test_a_gust_beside_a_part_is_in_the_repaired_simulator(both: Diagnosis, tmp_path: Path) -> None:
    assert both.verdict.names == ("sensor_bias", "gust")
    assert both.plant is not None
    assert both.budget is not None
    (gust,) = (e for e in both.plant.effects if isinstance(e, Gust))
    stated = both.budget.chance[0].parameters
    assert stated is not None
    assert {key: float(x) for key, x in gust.values().items()} == {key: q.mean for key, q in stated.items()}
    both.write(tmp_path)
    text = (tmp_path / "plant.toml").read_text()
    assert text.startswith("# By chance, drawn anew in every drive and not part of `closed`: gust.\n")
    again = GapPlant.from_toml(text)
    assert [e.name for e in again.effects] == ["gust", "sensor_bias"]


def test_what_the_gust_does_is_no_longer_in_the_jerk_noise(both: Diagnosis) -> None:
    assert both.plant is not None
    assert both.simulator is not None
    assert float(both.plant.sigma) < float(both.simulator.sigma)


def test_rollouts_and_what_they_close_are_of_the_parts_alone(both: Diagnosis) -> None:
    assert both.traces is not None
    assert both.plant is not None
    calm = plant([e for e in both.plant.effects if not e.random], T_L=both.plant.T_L, K_L=both.plant.K_L)
    assert [e.name for e in calm.effects] == ["sensor_bias"]
    assert both.belief is not None
    assert set(both.belief) == set(calm.values())
    assert both.shrinkage is not None
    assert both.shrinkage.top.closed is not None


@pytest.mark.slow
def test_a_gust_that_is_named_alone_has_a_repaired_simulator() -> None:
    found = pushed([])
    assert found.verdict.names == ("gust",)
    assert found.plant is not None
    assert [e.name for e in found.plant.effects] == ["gust"]
    # no rollout predicts it, so nothing closes
    assert found.shrinkage is None


def test_outliers_are_in_units_of_the_sensors_noise_and_the_unlikely_is_left_out() -> None:
    stated = {"fraction": Quantity(0.02, 0.0, 0.02, 0.02), "scale": Quantity(8.0, 0.0, 8.0, 8.0)}
    chance = (ChancePart("outliers", 0.9, None, stated), ChancePart("gust", 0.4, None, {}))
    share = Quantity(1.0, 0.0, 1.0, 1.0)
    budget = Budget(1.0, 1.0, {}, (), Unexplained(share, material=False), {}, {}, chance=chance)
    noise = NoiseModel(process_sd=0.05, process_time=0.5, accel_sd=0.07)
    car = with_chance(plant([]), budget, [Outliers, Gust], noise)
    assert car.effects == (Outliers(0.02, 8.0, noise_sd=0.07),)
    assert float(car.sigma) == pytest.approx(0.05 * np.sqrt(2 / 0.5))
