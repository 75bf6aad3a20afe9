"""Effects around another simulator: with the plant's own actuator as that simulator, the whole is the plant."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pytest
import torch

from avtorch import InputError
from avtorch.gap import (
    AerodynamicDrag,
    BrakeThrottleAsymmetry,
    DeadBand,
    DeadTime,
    DrivelineOscillation,
    Effect,
    Gust,
    RateLimit,
    SecondOrderActuator,
    SensorBias,
    SensorLag,
    SimulatorInput,
    SpeedDependentGain,
    SpeedDependentLag,
    plant,
)
from avtorch.gap.simulator.around import Around

DT, LAG, ROWS = 0.05, 0.4, 300
TIME = np.arange(ROWS) * DT
COMMAND = np.sin(1.3 * TIME) + 0.6 * np.sign(np.sin(3.1 * TIME))


def together(effects: Sequence[Effect], dt: float = DT) -> tuple[np.ndarray, np.ndarray]:
    """A first-order car, integrated exactly here, with the effects around it: accelerations and speeds, from row 0."""
    around = Around(plant(effects, T_L=LAG, K_L=0.7), dt)
    accel, speed = float(COMMAND[0]), 20.0
    rows = []
    for u in COMMAND.tolist():
        given = around.command(u, accel, speed)
        rows.append(around.car(u, accel, speed))
        around.advance(u, accel, speed)
        share = math.exp(-dt / LAG)
        target = 0.7 * given
        speed += target * dt + (accel - target) * LAG * (1 - share)
        accel = target + (accel - target) * share
    return tuple(np.array(rows).T)


def whole(effects: Sequence[Effect], speed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The response over the whole drive, at the car's own speed; the actuator starts as the other simulator does."""
    start = Around(plant([e for e in effects if e.place != "sensor"]), DT).car(COMMAND[0], COMMAND[0], 20.0)[0]
    drive = SimulatorInput(torch.tensor(TIME), torch.tensor(COMMAND), torch.tensor(speed), start)
    response = plant(effects, T_L=LAG, K_L=0.7).response(drive)
    return response.accel_measured.numpy(), response.speed.numpy()


@pytest.mark.parametrize(
    "effects",
    [
        [],
        [DeadTime(0.2)],
        [DeadBand(0.2)],
        [BrakeThrottleAsymmetry(brake_gain_ratio=0.8, brake_lag_ratio=1.0)],
        [SpeedDependentGain()],
        [SensorLag(0.2), SensorBias(0.1)],
        [AerodynamicDrag(4e-4)],
        pytest.param([DrivelineOscillation()], marks=pytest.mark.slow),
        [DeadTime(0.15), SpeedDependentGain(), AerodynamicDrag(4e-4), SensorLag(0.2)],
    ],
    ids=lambda effects: "+".join(e.name for e in effects) or "none",
)
def test_the_parts_together_are_the_plant(effects: list[Effect]) -> None:
    accel, speed = together(effects)
    expected_accel, expected_speed = whole(effects, speed)
    # each row adds a few roundings of numbers of the size of the speed
    close = {"rtol": 0.0, "atol": 8 * ROWS * 2.0**-52 * speed.max()}
    np.testing.assert_allclose(accel, expected_accel, **close)
    np.testing.assert_allclose(speed, expected_speed, **close)


def test_a_delay_within_a_step_is_given_as_the_steps_mean() -> None:
    """0.02 s late in steps of 0.05 s: two fifths of the old command, three of the new one."""
    around = Around(plant([DeadTime(0.02)]), DT)
    around.advance(1.0, 0.0, 20.0)
    assert around.command(2.0, 0.0, 20.0) == pytest.approx(0.4 * 1.0 + 0.6 * 2.0, rel=1e-12)


def test_asking_changes_nothing() -> None:
    first, asked = (Around(plant([DeadTime(0.1), SensorLag, AerodynamicDrag]), DT) for _ in range(2))
    for k, u in enumerate(COMMAND[:20].tolist()):
        for _ in range(k % 3):
            asked.command(-u, 1.0, 15.0)
            asked.car(u, 2.0, 18.0)
        assert asked.command(u, 0.1 * k, 20.0) == first.command(u, 0.1 * k, 20.0)
        assert asked.car(u, 0.1 * k, 20.0) == first.car(u, 0.1 * k, 20.0)
        first.advance(u, 0.1 * k, 20.0)
        asked.advance(u, 0.1 * k, 20.0)


def test_random_effects_are_those_of_the_seed() -> None:
    def shown(seed: int) -> list[float]:
        around = Around(plant([Gust], seed=seed), DT)
        speeds = []
        for _ in range(20):
            around.advance(0.0, 0.0, 20.0)
            speeds.append(around.car(0.0, 0.0, 20.0)[1])
        return speeds

    assert shown(1) == shown(1) != shown(2)


@pytest.mark.parametrize("effect", [SecondOrderActuator(), RateLimit(), SpeedDependentLag(), BrakeThrottleAsymmetry()])
def test_what_acts_within_the_actuator_is_refused(effect: Effect) -> None:
    with pytest.raises(InputError, match=rf"^{effect.name}: acts within the actuator"):
        Around(plant([effect, AerodynamicDrag]), DT)
