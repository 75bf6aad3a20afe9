"""A plant's linear response against closed forms."""

import pytest
import torch

from avtorch.gap import (
    AerodynamicDrag,
    BrakeThrottleAsymmetry,
    ConstantResistance,
    DeadTime,
    GainChange,
    Gust,
    RoadGrade,
    SecondOrderActuator,
    SensorBias,
    SensorLag,
    SensorScale,
    plant,
)
from avtorch.gap.linearised import linearised

T, K = 0.5, 0.8


def _glvd(omega: torch.Tensor) -> torch.Tensor:
    return K / (1 + 1j * omega * T)


def test_a_dead_time_and_a_sensor() -> None:
    car = plant([DeadTime(0.23), SensorLag(0.3), SensorScale(1.1), SensorBias(0.2)], T_L=T, K_L=K)
    chain = linearised(car, speed=20.0)
    s = 1j * chain.omega
    low = chain.omega < 30
    # rows of 10 ms, between which the response is taken to run straight
    torch.testing.assert_close(
        chain.motion[0, low], (_glvd(chain.omega) * torch.exp(-0.23 * s))[low], atol=2e-3, rtol=0
    )
    seen = (chain.motion * chain.sensed)[0]
    torch.testing.assert_close(seen[low], (chain.motion[0] * 1.1 / (1 + 0.3 * s))[low], atol=2e-3, rtol=0)
    assert float(chain.drag) == 0.0


def test_a_second_pole() -> None:
    car = plant([SecondOrderActuator.of({"natural_frequency_radps": 3.0, "damping_ratio": 0.4})], K_L=K)
    chain = linearised(car, speed=10.0)
    s = 1j * chain.omega
    want = K / (1 + 2 * 0.4 * s / 3 + (s / 3) ** 2)
    torch.testing.assert_close(chain.motion[0], want, atol=2e-3, rtol=0)


def test_forces_that_do_not_move_with_the_command_show_as_drag_or_not_at_all() -> None:
    car = plant([AerodynamicDrag(4e-4), ConstantResistance(0.2), RoadGrade(0.03), Gust()], T_L=T, K_L=K)
    chain = linearised(car, speed=25.0)
    torch.testing.assert_close(chain.motion[0], _glvd(chain.omega), atol=3e-4, rtol=0)
    assert float(chain.drag) == pytest.approx(2 * 4e-4 * 25, rel=1e-6)


def test_draws_pedals_and_what_has_changed() -> None:
    belief = {"T_L": torch.tensor([0.2, 0.6]), "brake_throttle_asymmetry.brake_gain_ratio": torch.tensor([0.5, 0.7])}
    car = plant([BrakeThrottleAsymmetry(), GainChange(0.9, change_s=40.0)], T_L=T, K_L=K)
    drives, brakes = (linearised(car, belief, speed=15.0, step=step) for step in (0.5, -0.5))
    assert drives.motion.shape[0] == 2
    at_rest = [c.motion[:, 0].real for c in (drives, brakes)]
    torch.testing.assert_close(at_rest[0], torch.full((2,), 0.9 * K, dtype=torch.float64), atol=1e-4, rtol=0)
    torch.testing.assert_close(at_rest[1], 0.9 * K * torch.tensor([0.5, 0.7], dtype=torch.float64), atol=1e-4, rtol=0)
