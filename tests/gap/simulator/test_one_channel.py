"""Aliases under one channel: exact in the response, and effects that this channel cannot show."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
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
from avtorch.gap.simulator.effect_response import is_observable, lookalikes, not_observable
from tests.gap.records import command_over

ACCEL, SPEED, BOTH = ("accel",), ("speed",), ("accel", "speed")
FORCES = {"aerodynamic_drag", "viscous_drag", "road_grade"}


def test_untested_forces_alias_offsets_and_gusts() -> None:
    assert lookalikes("sensor_bias", ACCEL) == lookalikes("gust", ACCEL) == {*FORCES, "low_speed_creep"}
    assert lookalikes("sensor_bias", ACCEL, specific_force=True) == {*FORCES, "low_speed_creep"} - {"road_grade"}
    # one force may be all that is slow
    assert lookalikes("constant_resistance+gust", ACCEL) == FORCES
    assert lookalikes("constant_resistance+dead_time", ACCEL) == {"+".join(sorted(["dead_time", x])) for x in FORCES}
    for name, channels in (("dead_time", ACCEL), ("sensor_bias", BOTH), ("gust", SPEED), ("none", ACCEL)):
        assert lookalikes(name, channels) == set()


def test_untested_effects_are_reported() -> None:
    assert all(is_observable(e, BOTH) for e in EFFECTS.values())
    assert not_observable(BOTH, EFFECTS.values()) is None
    unseen = {e.name for e in EFFECTS.values() if not is_observable(e, SPEED)}
    assert unseen == {"outliers", "sensor_bias", "sensor_lag", "sensor_scale", "speed_lag"}
    said = not_observable(SPEED, EFFECTS.values())
    assert said is not None
    assert said.endswith("outliers, sensor_bias, sensor_lag, sensor_scale, speed_lag.")
    said = not_observable(ACCEL, EFFECTS.values())
    assert said is not None
    for name in ("aerodynamic_drag", "gear_shift", "low_speed_creep", "road_grade", "speed_dependent_lag"):
        assert name in said
    assert "sensor_scale is equivalent to another K_L" in said
    assert "constant_resistance" not in said
    assert not_observable(ACCEL, [DeadTime]) is None


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
