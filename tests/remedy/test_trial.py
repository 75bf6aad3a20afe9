"""Effects switched off and moved: the error follows as it must."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import avtorch
from avtorch.errors import InputError
from avtorch.gap import DeadTime, GapPlant, Gust, SensorBias, plant
from avtorch.gap.result.counted_rows import CountedRows
from avtorch.io import Log
from avtorch.remedy import Trial

CAR = plant([DeadTime(0.3), SensorBias(0.2)], T_L=0.4, sigma=0.0)


@pytest.fixture(scope="module")
def log() -> Log:
    return avtorch.simulate(avtorch.Leader.default(start=50.0, duration=40.0, dt=0.05), plant=CAR).log()


@pytest.fixture(scope="module")
def trial(log: Log) -> Trial:
    return Trial(CountedRows.of(log), plant([], T_L=0.6, K_L=1.0, sigma=0.0), CAR)


def test_the_car_itself_leaves_nothing(trial: Trial) -> None:
    lines, errors = trial.rollout(CAR, {"dead_time", "sensor_bias"}, {})
    # the first row's acceleration is an average of 0.3 s, which a rollout forgets in some lags
    assert errors["accel"] < 5e-3
    assert np.abs(lines[0] - trial.traces.measured[0]).max() < 0.05


def test_a_bias_switched_off_is_the_error(trial: Trial) -> None:
    _, errors = trial.rollout(CAR, {"dead_time"}, {})
    whole = trial.rollout(CAR, {"dead_time", "sensor_bias"}, {})[1]
    # a rollout starts at the measured acceleration and forgets it within the lag, 0.4 s out of 10 s
    assert errors["accel"] == pytest.approx(0.2, rel=0.1)
    assert errors["speed"] == whole["speed"]  # a sensor does not move the car
    _, half = trial.rollout(CAR, {"dead_time", "sensor_bias"}, {"sensor_bias.bias_mps2": 0.1})
    assert half["accel"] == pytest.approx(0.5 * errors["accel"], rel=0.05)


def test_sizes_of_what_is_off_do_not_count(trial: Trial) -> None:
    assert (
        trial.rollout(CAR, {"dead_time"}, {"sensor_bias.bias_mps2": 9.0})[1] == trial.rollout(CAR, {"dead_time"}, {})[1]
    )


def test_sizes_hold_their_value(trial: Trial) -> None:
    sizes = trial.sizes(CAR)
    assert set(sizes) == {"T_L", "K_L", "dead_time.delay_s", "sensor_bias.bias_mps2"}
    assert all(x.low < x.value < x.high for x in sizes.values())
    assert sizes["dead_time.delay_s"].low == 0.0  # it can be moved to nothing


def test_an_effect_can_be_added(trial: Trial) -> None:
    names = trial.addable()
    assert "aerodynamic_drag" in names
    assert not {"dead_time", "sensor_bias", "gust", "road_grade"} & set(names)
    for name in names:
        car = trial.with_effect(trial.car, name)
        assert name in {e.name for e in car.effects}
        assert any(key.startswith(f"{name}.") for key in trial.sizes(car))


def test_what_chance_decides_leaves_the_rollout(trial: Trial) -> None:
    gusty = plant([Gust], baseline=CAR)
    on = {"dead_time", "sensor_bias"}
    assert trial.rollout(gusty, on | {"gust"}, {})[1] == trial.rollout(gusty, on, {})[1]


def test_a_size_out_of_bounds_is_refused(trial: Trial) -> None:
    with pytest.raises(InputError):
        trial.rollout(CAR, {"dead_time"}, {"T_L": -1.0})


def test_from_the_files_of_a_diagnosis(log: Log, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"diagnosis\.json: cannot be read"):
        Trial.of(log, tmp_path)
    (tmp_path / "diagnosis.json").write_text('{"baseline": {"T_L": {"mean": 0.6}, "K_L": {"mean": 0.9}}}')
    bare = Trial.of(log, tmp_path)
    assert float(bare.car.T_L) == 0.6
    (tmp_path / "plant.toml").write_text(CAR.to_toml())
    assert isinstance(Trial.of(log, tmp_path).car, GapPlant)
    assert {e.name for e in Trial.of(log, tmp_path).car.effects} == {"dead_time", "sensor_bias"}
