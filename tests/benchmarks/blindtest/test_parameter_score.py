"""Sizes of rightly named causes, and that their numbers mean the same to the reference vehicle and to the table."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from avtorch.gap import SimulatorInput, plant
from avtorch.gap.simulator.effect import effect_class
from benchmarks.blindtest import EFFECTS, IN_FRONT, Car, Recorded, simulate
from benchmarks.blindtest.answers import read_answer
from benchmarks.blindtest.intervals import wilson
from benchmarks.blindtest.parameter_score import SAME, SIZE_OF, found_sizes
from benchmarks.blindtest.score import score
from tests.benchmarks.blindtest.test_budget_score import divided
from tests.benchmarks.blindtest.test_score import answer

CAUSES: dict[str, dict[str, float]] = {
    "dead_time": {"delay_s": 0.3},
    "sensor_scale": {"scale": 1.2},
    "road_grade": {"grade_rms": 0.03, "length_m": 100.0},
}


def test_every_effect_in_front_has_a_size_that_both_sides_tell() -> None:
    assert SIZE_OF.keys() == IN_FRONT.keys()
    for effect, (parameter, without, _) in SIZE_OF.items():
        own = {p.name: p for p in effect_class(effect).parameters}
        assert own[parameter].reported, effect
        assert without == own[parameter].neutral, effect


def case(causes: dict[str, dict[str, float]], kind: str = "several") -> dict[str, Any]:
    return {
        "case": "case_00000",
        "kind": kind,
        "verdict": "+".join(sorted(causes)) or "none",
        "parameters": causes,
        "tier": "easy",
        "onset_s": None,
        "onset_scored": True,
        "drive": {"seconds": 60.0},
        "budget": {
            "parts": [{"names": [n], "share": 0.5, "after": 1.0} for n in causes],
            "unexplained": {"share": 0.0},
        },
    }


def told(mean: float, q05: float | None = None, q95: float | None = None) -> dict[str, float]:
    return {"mean": mean} if q05 is None or q95 is None else {"mean": mean, "q05": q05, "q95": q95}


def sized(
    parameters: dict[str, dict[str, dict[str, float]]], *, unsure: tuple[str, ...] = (), chance: tuple[str, ...] = ()
) -> dict[str, Any]:
    """An answer whose budget names the causes of `parameters`; those `unsure` have a probability of 0.3."""
    sure = {name: 0.5 for name in parameters if name not in (*unsure, *chance)}
    said = divided(sure, unsure=dict.fromkeys(unsure, 0.1), chance=chance)
    for part in (*said["budget"]["parts"], *said["budget"]["chance"]):
        part["parameters"] = parameters[part["names"][0]]
    return said


def test_sizes_of_rightly_named_parts_are_held_against_the_truth() -> None:
    said = sized(
        {
            "dead_time": {"delay_s": told(0.32, 0.27, 0.36)},
            "sensor_scale": {"scale": told(1.1, 1.08, 1.12)},
            "road_grade": {"grade_rms": told(0.03, 0.02, 0.04)},  # not the same quantity
            "dead_band": {"half_width_mps2": told(0.1, 0.05, 0.15)},  # no cause of the case
        }
    )
    late, scale = found_sizes(read_answer(case(CAUSES), said))
    assert (late.effect, late.covered, late.right) == ("dead_time", True, True)
    assert late.ratio == pytest.approx(0.32 / 0.3)
    # gains multiply: of a reading a fifth too large half was found
    assert (scale.covered, scale.right) == (False, False)
    assert scale.ratio == pytest.approx(np.log(1.1) / np.log(1.2))
    s = score([case(CAUSES)], [said], resamples=5)
    assert (s["parameters_covered"], s["parameters_right"]) == (0.5, 0.5)
    assert (s["counts"]["parameters_covered"], s["counts"]["parameters_right"]) == (2, 2)
    assert s["intervals"]["parameters_covered"] == list(wilson(1, 2) or ())


def test_parts_that_are_not_named_and_answers_without_a_budget_have_no_sizes() -> None:
    late = {"dead_time": {"delay_s": told(0.3, 0.2, 0.4)}}
    assert found_sizes(read_answer(case(CAUSES), sized(late, unsure=("dead_time",)))) == []
    assert found_sizes(read_answer(case(CAUSES), answer({"dead_time": 1.0}, "dead_time"))) == []
    assert found_sizes(read_answer(case({}, "none"), sized(late))) == []
    assert found_sizes(read_answer(case(CAUSES), None)) == []
    kept = {key: value for key, value in case(CAUSES).items() if key != "parameters"}
    s = score([kept], [sized(late)], resamples=5)
    assert (s["parameters_covered"], s["parameters_right"], s["counts"]["parameters_covered"]) == (None, None, 0)


def test_a_cause_of_chance_has_a_size_and_one_without_interval_is_not_bounded() -> None:
    causes = {"gust": {"sd_mps2": 0.2, "time_constant_s": 3.0}, "rate_limit": {"jerk_max_mps3": 1.5}}
    said = sized(
        {"gust": {"sd_mps2": told(0.19, 0.15, 0.24)}, "rate_limit": {"jerk_max_mps3": told(2.0)}}, chance=("gust",)
    )
    limit, gust = found_sizes(read_answer(case(causes), said))
    assert (gust.covered, gust.right) == (True, True)
    assert (limit.covered, limit.right) == (None, False)
    s = score([case(causes)], [said], resamples=5)
    assert (s["counts"]["parameters_covered"], s["counts"]["parameters_right"]) == (1, 2)


def test_each_size_is_told_by_answers_and_drawn_for_cases() -> None:
    from benchmarks.blindtest.drives import draw_drive

    rng = np.random.default_rng(1)
    drive, car = draw_drive(rng), Car()
    for effect, (parameter, without, _) in SAME.items():
        own = {p.name: p for p in (*effect_class(effect).parameters, *effect_class(effect).derived)}
        assert own[parameter].reported, effect
        assert own[parameter].neutral in (without, None), effect
        assert parameter in EFFECTS[effect].draw(rng, car, drive)(1.0), effect


T_L, K_L, RATE = 0.37, 0.93, 50
TIME = np.arange(60 * RATE) / RATE
COMMAND = 0.8 * np.sin(0.9 * TIME) + np.where((TIME % 6) < 3, 0.7, -0.7)
PREDICTABLE: dict[str, dict[str, float]] = {
    "dead_time": {"delay_s": 0.3},
    "dead_band": {"half_width_mps2": 0.3},
    "backlash": {"half_width_mps2": 0.3},
    "saturation": {"accel_max_mps2": 0.9, "accel_min_mps2": -1.0},
    "brake_throttle_asymmetry": {"brake_gain_ratio": 0.7, "brake_lag_ratio": 1.0},
    "second_order_actuator": {"natural_frequency_radps": 3.0, "damping_ratio": 0.5},
    "hand_over": {"pause_s": 0.3},
    "rate_limit": {"jerk_max_mps3": 1.0, "fall_ratio": 0.6},
    "viscous_drag": {"drag_per_s": 0.015},
    "gain_change": {"gain_ratio": 0.7, "change_s": 25.0, "takes_s": 0.2},
    "driveline_oscillation": {"frequency_hz": 1.5, "amplitude": 0.5, "damping_ratio": 0.05},
    "aerodynamic_drag": {"drag_per_m": 5e-4, "wind_mps": 2.0, "wind_swing_mps": 0.0, "wind_period_s": 60.0},
    "constant_resistance": {"resistance_mps2": 0.2},
    "sensor_lag": {"lag_s": 0.3},
    "speed_lag": {"lag_s": 0.3},
    "sensor_bias": {"bias_mps2": 0.2},
    "sensor_scale": {"scale": 1.2},
}
TABLE_KEYS = {"takes_s": "ramp_s", "damping_ratio": "mode_damping"}
"""What the table calls a number of the reference vehicle otherwise."""


def misfit(effect: str, given: dict[str, float], factor: float, start_speed: float = 20.0) -> float:
    """Error of the simulator, with `factor` times the reference vehicle's size of the effect, against that vehicle."""
    run = simulate(
        Car(T_L, K_L).silent(),
        Recorded(COMMAND, start_speed=start_speed),
        seconds=float(len(TIME) / RATE),
        rate_hz=RATE,
        effects={effect: given},
    )
    parameter = SAME[effect][0] if effect in SAME else next(iter(given))
    known = {p.name for p in (*effect_class(effect).parameters, *effect_class(effect).derived)}
    values = {key if key in known else TABLE_KEYS.get(key, ""): value for key, value in given.items()}
    values = {key: value for key, value in values.items() if key in known} | {parameter: factor * given[parameter]}
    drive = SimulatorInput(torch.as_tensor(run.time), torch.as_tensor(run.command), torch.as_tensor(run.true_speed))
    lag = None if effect == "second_order_actuator" else T_L  # which has its own, by its damping
    response = plant([effect_class(effect).of(values)], T_L=lag, K_L=K_L).response(drive)
    found, shown = response.accel_measured.numpy(), run.accel
    if effect_class(effect).reading == "speed":
        found, shown = np.gradient(response.speed_measured.numpy()), np.gradient(run.speed)
    settled = slice(5 * RATE, None)  # one side starts at rest, the other in the first command's steady state
    return float(np.sqrt(np.mean((found - shown)[settled] ** 2)))


@pytest.mark.slow
@pytest.mark.parametrize("effect", PREDICTABLE)
def test_a_size_means_the_same_to_the_vehicle_and_to_the_table(effect: str) -> None:
    less, same, more = (misfit(effect, PREDICTABLE[effect], factor) for factor in (0.9, 1.0, 1.1))
    assert same < 0.5 * min(less, more)


@pytest.mark.slow
def test_a_creep_that_fits_is_another_number_than_the_vehicles() -> None:
    # the same push at standstill, which no row shows
    factors = np.linspace(0.5, 1.2, 15)
    errors = [misfit("low_speed_creep", {"creep_mps2": 0.3, "ends_mps": 3.2}, x, start_speed=1.0) for x in factors]
    assert "low_speed_creep" not in SAME
    assert factors[int(np.argmin(errors))] < 0.9


def test_all_other_effects_are_left_out_for_a_reason() -> None:
    chance = {"gust", "outliers", "command_hold"}
    assert SAME.keys() == PREDICTABLE.keys() | chance
    assert EFFECTS.keys() - SAME.keys() == {
        *("speed_dependent_gain", "speed_dependent_lag", "road_grade", "low_speed_creep", "gear_shift")
    }
