"""Aliases under one channel: exact in the response, and effects that this channel cannot show."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
import torch

from avtorch.gap import (
    EFFECTS,
    ConstantResistance,
    DeadTime,
    Effect,
    Saturation,
    SecondOrderActuator,
    SensorBias,
    SensorLag,
    SimulatorInput,
    plant,
)
from avtorch.gap.answer.aliases import exact_aliases, in_place_of, lookalikes, note
from avtorch.gap.simulator.observability import is_observable
from tests.gap.records import command_over

ACCEL, SPEED, BOTH = ("accel",), ("speed",), ("accel", "speed")
BELOW, ABOVE = {"sensor_bias.bias_mps2": -0.1}, {"sensor_bias.bias_mps2": 0.1}


# names ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "same"),
    [
        ("sensor_bias", {"constant_resistance"}),
        ("constant_resistance", {"sensor_bias"}),
        ("sensor_lag", {"second_order_actuator"}),
        ("dead_time+sensor_bias", {"constant_resistance+dead_time"}),
        ("gust+sensor_bias", {"constant_resistance+gust"}),
        ("saturation+sensor_lag", {"saturation+second_order_actuator"}),
        ("second_order_actuator+sensor_bias", {"sensor_bias+sensor_lag", "constant_resistance+second_order_actuator"}),
        ("rate_limit+sensor_lag", set()),  # a limit before the lag is not one after it
        ("constant_resistance+sensor_bias", set()),
        *((name, set()) for name in ("none", "unknown", "dead_time", "gust", "sensor_scale")),
    ],
)
def test_aliases_by_acceleration_only(name: str, same: set[str]) -> None:
    assert exact_aliases(name, ACCEL) == {name} | same
    for channels in (SPEED, BOTH):
        assert exact_aliases(name, channels) == {name}


def test_values_bound_the_aliases() -> None:
    assert exact_aliases("sensor_bias", ACCEL, BELOW) == {"sensor_bias", "constant_resistance"}
    assert exact_aliases("sensor_bias", ACCEL, ABOVE) == {"sensor_bias"}
    for damping, same in ((1.2, {"sensor_lag"}), (0.6, set())):
        values = {"T_L": 0.4 * damping, "second_order_actuator.inverse_frequency_s": 0.2}
        assert exact_aliases("second_order_actuator", ACCEL, values) == {"second_order_actuator"} | same


def test_untested_forces_alias_offsets_and_gusts() -> None:
    assert lookalikes("sensor_bias", ACCEL, BELOW) == {"aerodynamic_drag", "road_grade"}
    assert lookalikes("sensor_bias", ACCEL, ABOVE) == {"low_speed_creep", "road_grade"}
    assert lookalikes("sensor_bias", ACCEL, ABOVE, specific_force=True) == {"low_speed_creep"}
    assert lookalikes("gust", ACCEL) == {"aerodynamic_drag", "low_speed_creep", "road_grade"}
    # one force may be all that is slow
    assert lookalikes("gust+sensor_bias", ACCEL, BELOW) == {"aerodynamic_drag", "road_grade"}
    assert lookalikes("constant_resistance+dead_time", ACCEL) == {"aerodynamic_drag+dead_time", "dead_time+road_grade"}
    for name, channels in (("dead_time", ACCEL), ("sensor_bias", BOTH), ("gust", SPEED), ("none", ACCEL)):
        assert lookalikes(name, channels) == set()


def test_in_the_place_of_one_effect_beside_others() -> None:
    alike = {"constant_resistance", "aerodynamic_drag", "road_grade"}
    assert in_place_of("sensor_bias", ["dead_time"], ACCEL, BELOW) == alike
    assert in_place_of("sensor_bias", ["constant_resistance"], ACCEL, BELOW) == alike - {"constant_resistance"}
    assert in_place_of("sensor_bias", [], ACCEL, ABOVE) == {"low_speed_creep", "road_grade"}
    assert in_place_of("sensor_lag", ["rate_limit"], ACCEL) == set()
    for channels in (SPEED, BOTH):
        assert in_place_of("sensor_bias", [], channels, BELOW) == set()


def test_untested_effects_are_reported() -> None:
    assert all(is_observable(e, BOTH) for e in EFFECTS.values())
    assert note(BOTH, EFFECTS.values()) is None
    unseen = {e.name for e in EFFECTS.values() if not is_observable(e, SPEED)}
    assert unseen == {"outliers", "sensor_bias", "sensor_lag", "sensor_scale"}
    said = note(SPEED, EFFECTS.values())
    assert said is not None
    assert said.endswith("outliers, sensor_bias, sensor_lag, sensor_scale.")
    said = note(ACCEL, EFFECTS.values())
    assert said is not None
    for name in ("aerodynamic_drag", "gear_shift", "low_speed_creep", "road_grade", "speed_dependent_lag"):
        assert name in said
    assert "sensor_scale is equivalent to another K_L" in said
    assert "constant_resistance" not in said
    assert note(ACCEL, [DeadTime]) is None


# responses -----------------------------------------------------------------------------------------------


def _shown(effects: Sequence[Effect], T_L: float = 0.35, K_L: float = 1.0, rate_hz: int = 100) -> torch.Tensor:
    time = np.arange(20 * rate_hz) / rate_hz
    drive = SimulatorInput(torch.as_tensor(time), torch.as_tensor(command_over(time)))
    return plant(effects, T_L=T_L, K_L=K_L).response(drive).accel_measured


def test_aliases_respond_alike() -> None:
    for more in ([], [DeadTime(0.2)], [Saturation(0.6, -0.5)]):
        torch.testing.assert_close(_shown([*more, ConstantResistance(0.1)]), _shown([*more, SensorBias(-0.1)]))
        # two real poles, in either order; the sensor's takes the acceleration as linear between rows
        filtered = _shown([*more, SensorLag(0.2)], T_L=0.35)
        poles = _shown([*more, SecondOrderActuator((0.35 * 0.2) ** 0.5)], T_L=0.55)
        assert float((filtered - poles).abs().max()) < 2e-3 * float(filtered.abs().max())
    scaled = EFFECTS["sensor_scale"](scale=1.2)  # type: ignore[call-arg]
    torch.testing.assert_close(_shown([scaled]), _shown([], K_L=1.2))
