"""What effects declare of themselves is true of their response, and of their own parameters."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from avtorch.gap import EFFECTS, Effect, SimulatorInput, plant
from avtorch.gap.simulator.effect import delay_effect, delay_key
from avtorch.gap.simulator.integrated import Integrated

SURE = [kind for kind in EFFECTS.values() if not kind.random and not issubclass(kind, Integrated)]
NOISES = [{"force_sd", "force_time"}, {"tail_fraction", "tail_scale"}, {"loss"}]


def answer(kind: type[Effect], step: float) -> Tensor:
    """What the sensor shows (time,) of a step [m/s²] at 12 m/s, less what it shows without one."""
    time = 1e3 + 0.02 * torch.arange(400, dtype=torch.float64)
    command = torch.where(time > 1e3 + 1.0, step, 0.0)
    car = plant([kind])
    speed = torch.full_like(time, 12.0)
    shown = [car.response(SimulatorInput(time, u, speed)).accel_measured for u in (command, 0 * command)]
    return shown[0] - shown[1]


@pytest.mark.parametrize("kind", SURE, ids=lambda kind: kind.name)
def test_a_linear_one_answers_twice_the_step_twice(kind: type[Effect]) -> None:
    once, twice = answer(kind, 1.0), answer(kind, 2.0)
    assert kind.linear == torch.allclose(twice, 2 * once, rtol=0, atol=1e-9)


@pytest.mark.parametrize("kind", SURE, ids=lambda kind: kind.name)
def test_a_one_sided_one_answers_brakes_otherwise(kind: type[Effect]) -> None:
    assert kind.one_sided != torch.allclose(answer(kind, -3.0), -answer(kind, 3.0), rtol=0, atol=1e-9)


@pytest.mark.parametrize("kind", EFFECTS.values(), ids=lambda kind: kind.name)
def test_what_it_declares_is_of_its_own_parameters(kind: type[Effect]) -> None:
    names = {p.name for p in kind.parameters}
    named = {*kind.starts, *kind().values_after_onset(), *kind.noise_parameters.values()}
    named |= {name for name in (kind.own_onset, kind.shift) if name is not None}
    assert named <= names
    assert set(kind.noise_parameters) in (NOISES if kind.random else [set()])


def test_a_constant_force_points_as_declared() -> None:
    for kind in (k for k in SURE if k.force_sign):
        time = torch.arange(50, dtype=torch.float64) * 0.1
        drive = SimulatorInput(time, torch.zeros_like(time), torch.full_like(time, kind.pictured))
        force = plant([kind]).response(drive).accel_measured
        assert bool((force * kind.force_sign > 0).all())


def test_one_effect_stands_for_a_bare_delay() -> None:
    kind = delay_effect()
    assert [k for k in EFFECTS.values() if k.role == "delay"] == [kind]
    assert delay_key() in plant([kind]).parameters()
