"""The repaired simulator has what chance decides, too."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import lfilter

from avtorch import diagnose
from avtorch.gap import Effect, Gust, SensorBias, plant
from avtorch.gap.effects.outliers import Outliers
from avtorch.gap.result.diagnosis import Diagnosis
from avtorch.gap.simulator.plant import GapPlant
from tests.gap.cars import DT, log_of

SD, TIME_S = 0.3, 3.0
KINDS = ["sensor_bias", "dead_time", "gust"]


def pushed(effects: list[Effect]) -> Diagnosis:
    """A car with `effects` that wind pushes, behind sensors with coloured noise."""
    log = log_of(effects, seed=2)
    assert log.accel is not None
    assert log.speed is not None
    keep = np.exp(-DT / TIME_S)
    kicks = np.random.default_rng(2).normal(0.0, SD * np.sqrt(1 - keep**2), log.rows)
    force = np.asarray(lfilter([1.0], [1.0, -keep], kicks))
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
    assert found.shrinkage is not None
    for channel in ("accel", "speed"):
        metric = found.shrinkage.by_metric[f"rollout_rmse_{channel}"]
        assert metric.after == pytest.approx(metric.before, rel=0.05)


@pytest.mark.slow
def test_outliers_are_in_units_of_the_sensors_noise() -> None:
    """Of a sensor with white noise, a sample in fifty is off by ten times its standard deviation."""
    log, rng, sd = log_of([], noise=0.0), np.random.default_rng(4), 0.05
    assert log.accel is not None
    assert log.speed is not None
    far = rng.random(log.rows) < 0.02
    noise = sd * rng.standard_normal(log.rows) * np.where(far, 10.0, 1.0)
    read = replace(log, accel=log.accel + noise, speed=log.speed + 0.01 * rng.standard_normal(log.rows))
    found = diagnose(read, effects=["outliers", "sensor_bias"], pairs=False)
    assert found.verdict.names == ("outliers",)
    assert found.plant is not None
    (effect,) = found.plant.effects
    assert isinstance(effect, Outliers)
    # 60 of them, half of which stand out: sizes to a quarter
    assert effect.noise_sd == pytest.approx(sd, rel=0.15)
    assert 0.5 < float(effect.fraction) / 0.02 < 1.5
    assert 0.5 < float(effect.scale) / 10.0 < 2.0
