"""How large a cause is in the cars of a model: pooled over cars and drives, in the units of its parameters."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch

from avtorch.fleet.population import drive_sizes, effect_sizes
from tests.bars import BAR


def cause(name: str, **values: tuple[float, float]) -> dict[str, Any]:
    stats = [{"name": key, "value_mean": mean, "value_sd": sd} for key, (mean, sd) in values.items()]
    return {"name": name, "parameters": stats}


def late(*delays: float, sd: float = 0.01) -> list[dict[str, Any]]:
    """What drives say whose commands act so late."""
    return [drive_sizes([cause("dead_time", delay_s=(delay, sd))]) for delay in delays]


def test_a_typical_car_its_siblings_and_each_car_are_told_in_seconds() -> None:
    cars = {f"car {i}": late(0.20 + 0.005 * i, 0.205 + 0.005 * i) for i in range(7)}
    common, each = effect_sizes("dead_time", cars)
    delay = common["delay_s"]
    assert (delay["unit"], delay["cars"], delay["drives"], delay["converged"]) == ("s", 7, 14, True)
    assert delay["typical"]["q05"] < 0.2175 < delay["typical"]["q95"]
    # a car that was not driven is known less well than the mean of them
    assert delay["next_car"]["q05"] < delay["typical"]["q05"] < delay["typical"]["q95"] < delay["next_car"]["q95"]
    # drawn towards the others, and in order
    medians = [each[car]["delay_s"]["median"] for car in cars]
    assert medians == sorted(medians)
    assert medians[0] > 0.2025
    assert medians[-1] < 0.2325


def test_a_drive_that_tells_less_is_drawn_in_more() -> None:
    cars = {f"car {i}": late(0.2, sd=0.005) for i in range(6)} | {
        "sure": late(0.3, sd=0.005),
        "vague": late(0.3, sd=0.1),
    }
    _, each = effect_sizes("dead_time", cars)
    sure, vague = (each[car]["delay_s"] for car in ("sure", "vague"))
    assert 0.2 < vague["median"] < 0.26 < 0.28 < sure["median"] < 0.3
    assert vague["q95"] - vague["q05"] > 2 * (sure["q95"] - sure["q05"])


def test_a_size_of_either_sign_stays_what_it_is() -> None:
    cars = {str(i): [drive_sizes([cause("sensor_bias", bias_mps2=(-0.2 + 0.01 * i, 0.01))])] for i in range(4)}
    common, _ = effect_sizes("sensor_bias", cars)
    bias = common["bias_mps2"]
    assert bias["typical"]["q05"] < -0.185 < bias["typical"]["q95"] < 0
    assert bias["within"] is None, "no car has two drives"


def test_a_skewed_belief_is_taken_by_the_ends_of_its_interval() -> None:
    """Log-normal about 0.1 s, whose mean is 0.138: eight such drives do not say 0.138."""
    skewed = {
        "value_mean": 0.138,
        "value_sd": 0.13,
        "value_q05": 0.1 * math.exp(-1.316),
        "value_q95": 0.1 * math.exp(1.316),
    }
    drives = [drive_sizes([{"name": "dead_time", "parameters": [{"name": "delay_s", **skewed}]}])]
    common, _ = effect_sizes("dead_time", {str(i): drives for i in range(8)})
    assert common["delay_s"]["typical"]["median"] == pytest.approx(0.1, rel=0.05)
    # an end that the parameter cannot have: by mean and standard deviation
    edge = {"value_mean": 0.2, "value_sd": 0.02, "value_q05": -0.1, "value_q95": 0.5}
    (belief,) = drive_sizes([{"name": "dead_time", "parameters": [{"name": "delay_s", **edge}]}])["dead_time"].values()
    (plain,) = late(0.2, sd=0.02)[0]["dead_time"].values()
    assert belief == plain


def test_what_is_no_car_s_and_what_no_drive_tells_is_left_out() -> None:
    assert drive_sizes([cause("road_grade", grade_rms=(0.02, 0.001))]) == {}
    assert drive_sizes([cause("gain_change", gain_ratio=(0.7, 0.1), change_s=(30.0, 1.0))]) == {}
    assert drive_sizes([cause("of my own", x=(1.0, 0.1)), {"name": "dead_time", "parameters": None}]) == {}
    limits = cause("saturation", accel_max_mps2=(1.2, 0.1), accel_min_mps2=(-math.inf, 0.0))
    assert set(drive_sizes([limits])["saturation"]) == {"accel_max_mps2"}
    assert effect_sizes("dead_time", {"red": late(0.2), "blue": late(0.3), "green": [{}]}) == ({}, {})


@pytest.mark.statistical
def test_spreads_are_those_that_cars_and_drives_were_drawn_with(rotating_seed: int) -> None:
    from avtorch.gap import EFFECTS

    g = torch.Generator().manual_seed(rotating_seed)
    (parameter,) = EFFECTS["dead_time"].parameters
    count, between, within = 120, 0.4, 0.2
    car = 0.3 + between * torch.randn(count, 1, generator=g, dtype=torch.float64)
    z = car + within * torch.randn(count, 3, generator=g, dtype=torch.float64)
    cars = {str(i): late(*delays, sd=1e-5) for i, delays in enumerate(parameter.constrain(z).tolist())}
    found = effect_sizes("dead_time", cars)[0]["delay_s"]
    for name, true, error in (
        ("between", between, between / (2 * count) ** 0.5),
        ("within", within, within / (4 * count) ** 0.5),
    ):
        # 0.02 for the prior's pull
        assert abs(found[name]["median"] - true) < BAR * error + 0.02
    # the coordinate's mean: of the cars, whose own are known to their drives
    mean = float(parameter.unconstrain(torch.tensor(found["typical"]["median"], dtype=torch.float64)))
    assert abs(mean - 0.3) < BAR * (between**2 + within**2 / 3) ** 0.5 / count**0.5 + 0.02
