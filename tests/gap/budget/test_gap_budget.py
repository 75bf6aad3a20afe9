"""The budget names what was put in, divides the gap among it, and holds what is known of real cars by other means."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.signal import lfilter
from scipy.stats import t as student

from avtorch.errors import InputError
from avtorch.gap import (
    ConstantResistance,
    DeadBand,
    DeadTime,
    Effect,
    GainChange,
    RoadGrade,
    SecondOrderActuator,
    SensorBias,
    gap_budget,
)
from avtorch.gap.budget.repaired_model import SHAPE
from avtorch.io import Log
from tests.gap.budget.cars import log_of

FEW = ["dead_time", "dead_band", "constant_resistance", "sensor_bias", "sensor_scale"]


@pytest.mark.parametrize(
    ("effect", "key", "within"),
    [
        # a few per cent of each: 150 s, noise of 0.05 m/s² that lasts 1.5 s
        (ConstantResistance(0.2), "resistance_mps2", 0.05),
        pytest.param(DeadBand(0.25), "half_width_mps2", 0.06, marks=pytest.mark.slow),
        (DeadTime(0.3), "delay_s", 0.06),
        pytest.param(SensorBias(0.2), "bias_mps2", 0.05, marks=pytest.mark.slow),
    ],
)
def test_a_single_cause_is_the_whole_budget(effect: Effect, key: str, within: float) -> None:
    budget = gap_budget(log_of([effect], seed=11), effects=FEW)
    assert budget.names == (effect.name,)
    part = budget.parts[0]
    assert part.parameters[key].mean == pytest.approx(getattr(effect, key), abs=within)
    assert part.share.mean > 0.85
    assert part.onset_s is None


def test_a_size_is_no_surer_than_the_equation_it_is_of() -> None:
    """Of 54 sizes behind ordinary recorders 90 % intervals held 63 %: folds of a quarter of an hour hardly differ."""
    log = log_of([GainChange(0.6, 60.0)], seed=11, noise=1e-3)
    (part,) = gap_budget(log, effects=["gain_change"]).parts
    ratio, change = (part.parameters[key] for key in ("gain_ratio", "change_s"))
    assert ratio.sd == pytest.approx(SHAPE * (1 - ratio.mean), rel=0.3)
    assert ratio.q95 - ratio.mean == pytest.approx(float(student.ppf(0.95, 5)) * ratio.sd)
    assert change.sd < SHAPE * change.mean  # a time is no size


def test_the_size_of_a_road_is_that_of_its_coefficients() -> None:
    """It was the default, 0.03, whatever the road. Knots of 225 m smooth this one, whose grades last 180 m."""
    profile = torch.randn(64, generator=torch.Generator().manual_seed(5), dtype=torch.float64)
    road = RoadGrade(grade_rms=0.015, profile=profile)
    log = log_of([road], seed=11)
    assert log.speed is not None
    position = torch.as_tensor(np.cumsum(log.speed) / log.rate_hz)
    part = gap_budget(log, effects=["road_grade"]).parts[0]
    assert part.parameters["grade_rms"].mean == pytest.approx(float(road.size_along(position)), rel=0.25)


def test_acceleration_alone_does_not_tell_whose_force_it_is() -> None:
    """The verdict was a resistance with no alias, of a car whose accelerometer has an offset."""
    effects = [*FEW, "aerodynamic_drag", "road_grade"]
    alike = {
        -0.2: ("aerodynamic_drag", "constant_resistance", "road_grade", "sensor_bias"),
        0.2: ("road_grade", "sensor_bias"),
    }
    for offset, alias_set in alike.items():  # no resistance pushes
        log = log_of([SensorBias(offset)], seed=11)
        (part,) = gap_budget(replace(log, speed=None), effects=effects).parts
        assert part.name == ("constant_resistance" if offset < 0 else "sensor_bias")
        assert part.alias_set == alias_set


def test_acceleration_alone_does_not_tell_an_actuator_from_a_sensor() -> None:
    """A second pole may be the sensor's, unless the actuator overshoots. The answer's parameters are not the fit's."""
    effects = ["second_order_actuator", "sensor_lag"]
    for T_L, alike in ((0.65, ("second_order_actuator", "sensor_lag")), (0.2, ("second_order_actuator",))):
        log = log_of([SecondOrderActuator(inverse_frequency_s=0.25)], T_L=T_L, seed=11)  # damping 1.3 and 0.4
        (part,) = gap_budget(replace(log, speed=None), effects=effects).parts
        assert part.alias_set == alike


@pytest.mark.slow
def test_a_constant_force_is_no_road_and_may_be_a_slope_all_the_way() -> None:
    """A free course of the road took the place of a resistance of 1.3 m/s², a mean slope of 13 %."""
    log = log_of([ConstantResistance(0.3)], seed=11)
    assert gap_budget(log, effects=["road_grade"]).names == ()
    (part,) = gap_budget(log, effects=["road_grade", "constant_resistance"]).parts
    assert (part.name, part.alias_set) == ("constant_resistance", ("constant_resistance", "road_grade"))
    # 13 % all the way is no road
    assert ConstantResistance.alike({"resistance_mps2": 1.3}) == ()


@pytest.mark.slow
def test_a_slow_force_on_a_road_that_is_driven_once_may_be_that_roads() -> None:
    """What changes within a block belongs to the time as well as to the place, until the place is passed again."""
    log, keep = log_of(seed=11), float(np.exp(-0.05 / 3.0))
    assert log.speed is not None
    assert log.accel is not None
    kicks = np.random.default_rng(5).normal(0.0, 0.3 * np.sqrt(1 - keep**2), log.rows)
    force = np.asarray(lfilter([1.0], [1.0, -keep], kicks))
    pushed = replace(log, accel=log.accel + force, speed=log.speed + np.cumsum(force) * 0.05)
    (wind,) = gap_budget(pushed, effects=["gust", "road_grade"]).chance
    assert (wind.name, wind.alias_set) == ("gust", ("gust", "road_grade"))
    (wind,) = gap_budget(pushed, effects=["gust"]).chance  # of what was asked
    assert wind.alias_set == ("gust",)
    twice = gap_budget([pushed, pushed], effects=["gust", "road_grade"])  # what is finer than its knots stays
    assert twice.names[0] == "road_grade"


def test_a_levelled_road_is_the_same_road_without_its_mean_slope() -> None:
    position = torch.linspace(0.0, 40 * 80.0, 500, dtype=torch.float64)
    road = RoadGrade(knots=64)
    some = torch.randn(3, 64, generator=torch.Generator().manual_seed(1), dtype=torch.float64) + 2.0
    before, after = road.force(position, some), road.force(position, road.levelled(some))
    away = before - after
    torch.testing.assert_close(away, away.mean(-1, keepdim=True).expand_as(away))
    torch.testing.assert_close(road.levelled(road.levelled(some)), road.levelled(some))


@pytest.mark.parametrize("seed", [0, 1, 2, 3])
def test_coloured_noise_is_no_cause(seed: int) -> None:
    budget = gap_budget(log_of(seed=seed), effects=FEW)
    assert budget.verdict == ("none",)


def test_a_cause_is_named_where_slow_noise_hides_what_it_does_to_rollouts() -> None:
    """A dead band of a third of the command's SD: certain, and 10 s of wind move the speed more than it does."""
    log = log_of([DeadBand(0.25)], seed=11, noise=4.0)
    assert gap_budget(log, effects=["dead_band"]).names == ("dead_band",)


@pytest.mark.slow
def test_parts_are_in_order_and_sum_to_one() -> None:
    log = log_of([ConstantResistance(0.2), SensorBias(0.1), DeadBand(0.25)], seed=2)  # each over 3 % of the gap
    budget = gap_budget(log, effects=FEW)
    assert set(budget.names) == {"constant_resistance", "sensor_bias", "dead_band"}
    shares = [part.share.mean for part in budget.parts]
    assert sum(shares) + budget.unexplained.share.mean == pytest.approx(1.0, abs=1e-9)
    for part in budget.parts:
        assert part.name in part.alias_set
        assert part.share.q05 <= part.share.mean <= part.share.q95
    assert budget.before > budget.left >= 1.0
    assert "constant_resistance" in str(budget)


@pytest.mark.slow
def test_the_same_log_has_the_same_budget() -> None:
    log = log_of([DeadBand(0.25)], seed=4, seconds=60.0)
    assert gap_budget(log, effects=FEW).to_dict() == gap_budget(log, effects=FEW).to_dict()


def test_wrong_arguments_are_refused() -> None:
    log = log_of(seconds=60.0)
    with pytest.raises(InputError, match="material"):
        gap_budget(log, material=0.0)
    with pytest.raises(InputError, match="perhaps dead_time"):
        gap_budget(log, effects=["dead_tim"])


@pytest.mark.slow
@pytest.mark.parametrize(("file", "bias"), [("single_mass", -0.235), ("Normal_1weight", -0.228)])
def test_the_bias_of_a_real_accelerometer_is_in_its_interval(data_dir: Path, file: str, bias: float) -> None:
    """Mean of accel - dv/dt while moving, by the columns themselves."""
    budget = gap_budget(Log.read(data_dir / "roboracer" / f"{file}.csv"))
    part = next(part for part in budget.parts if part.name == "sensor_bias")
    found = part.parameters["bias_mps2"]
    assert found.q05 <= bias <= found.q95
    assert found.q05 < found.q95


@pytest.mark.slow
def test_a_bias_that_is_no_part_among_all_effects_is_found_beside_a_resistance(data_dir: Path) -> None:
    """With other tyres the whole table leaves 6 nats for the bias, which is -0.174 m/s² by the columns themselves."""
    log = Log.read(data_dir / "roboracer" / "tire_set_1.csv")
    budget = gap_budget(log, effects=["constant_resistance", "sensor_bias"])
    found = next(part for part in budget.parts if part.name == "sensor_bias").parameters["bias_mps2"]
    assert found.q05 <= -0.174 <= found.q95


@pytest.mark.slow
def test_a_model_cars_resistance_is_what_its_authors_say(data_dir: Path) -> None:
    """Right cause, and 2.9 m/s², their model's at this drive's mean speed, in its interval."""
    budget = gap_budget(Log.read(data_dir / "dart" / "09_16_2024_10_27_02_onboard10Hz.csv"))
    assert budget.parts[0].name == "constant_resistance"
    found = budget.parts[0].parameters["resistance_mps2"]
    assert found.mean == pytest.approx(2.9, rel=0.25)
    assert found.q05 <= 2.9 <= found.q95


@pytest.mark.slow
def test_no_part_rests_at_a_limit_and_intervals_have_a_width(data_dir: Path) -> None:
    """A road on a laboratory's floor, its coefficients at three times their prior's reach, all without an interval."""
    budget = gap_budget(Log.read(data_dir / "roboracer/ftg_stanley_total_validation.csv"))
    assert "road_grade" not in budget.names
    for part in budget.parts:
        assert all(q.q95 > q.q05 for q in part.parameters.values()), part.name


@pytest.mark.slow
def test_a_short_drive_is_divided_into_short_blocks() -> None:
    """Twenty seconds hold four blocks of four; `diagnose` answers them, and so does the budget by itself."""
    log = log_of([SensorBias(0.4)], seed=11, seconds=20.0)
    assert gap_budget(log, effects=FEW).names == ("sensor_bias",)
    with pytest.raises(InputError, match="needs"):
        gap_budget(log_of(seconds=7.0), effects=FEW)
