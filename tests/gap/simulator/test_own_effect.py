"""The page on own effects, docs/own-effect.md: its code runs and does what the page states."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import torch

from avtorch.errors import InputError
from avtorch.gap import EFFECTS, Effect, GapPlant, SimulatorInput, plant
from avtorch.gap.simulator.effect import effect_class
from tests.gap.drives import drive_of, driven

PAGE = Path(__file__).resolve().parents[3] / "docs" / "own-effect.md"


@pytest.fixture
def shown():
    """What the page's code defines; the registry is as before after the test."""
    before = dict(EFFECTS)
    names: dict = {}
    blocks = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.S)
    assert len(blocks) >= 3
    assert len([line for line in blocks[0].splitlines() if line.strip()]) <= 20
    for block in (
        b for b in blocks if "diagnose(" not in b
    ):  # tests/gap/simulator/test_own_effect_page.py runs that one
        exec(compile(block, "own-effect.md", "exec", dont_inherit=True), names)
    yield names
    EFFECTS.clear()
    EFFECTS.update(before)


def test_it_is_known_by_name_and_drives(shown: dict) -> None:
    assert effect_class("trailer") is shown["Trailer"]
    car = GapPlant.from_toml("trailer=0.4", effects=[shown["Trailer"]])
    assert car.to_toml().endswith("[trailer]\nmass_ratio = 0.4\n")
    block = driven(plant([shown["Trailer"](0.4)], sigma=0.0))
    response = plant([shown["Trailer"](0.4)]).response(drive_of(block))
    torch.testing.assert_close(response.accel_measured[1:], block.accel[0, 1:], rtol=0, atol=1e-9)


def test_it_is_neutral_and_differentiable(shown: dict) -> None:
    neutral = driven(plant([shown["Trailer"].neutral()]))
    assert torch.equal(neutral.accel, driven(plant()).accel)
    time = torch.arange(60, dtype=torch.float64) * 0.1
    drive = SimulatorInput(time, torch.sin(time), 10 + time)
    ratio = torch.tensor([0.2, 0.4], dtype=torch.float64, requires_grad=True)
    car = plant([shown["Trailer"]])
    assert torch.autograd.gradcheck(lambda m: car.response(drive, {"trailer.mass_ratio": m}).accel[:, ::9], (ratio,))


def test_one_with_memory_needs_no_second_form(shown: dict) -> None:
    car = plant([shown["HotMotor"](0.3)], sigma=0.0)
    block = driven(car, seconds=3.0)
    response = car.response(drive_of(block))
    torch.testing.assert_close(response.accel_measured[1:], block.accel[0, 1:], rtol=0, atol=1e-9)
    fades = torch.tensor([0.1, 0.3], dtype=torch.float64)
    both = car.response(drive_of(block), {"hot_motor.fade": fades})
    torch.testing.assert_close(both.accel[1], response.accel, rtol=0, atol=1e-12)
    # without `over`, rows are looped over
    rows = type("Rows", (shown["HotMotor"],), {"over": Effect.over})
    looped = plant([rows(0.3)], sigma=0.0).response(drive_of(block))
    torch.testing.assert_close(looped.accel, response.accel, rtol=0, atol=1e-12)
    assert float((block.accel - driven(plant(sigma=0.0), seconds=3.0).accel).abs().max()) > 0.05


def test_one_with_speed_pulls_less_the_faster_it_is(shown: dict) -> None:
    car = plant([shown["MotorPower"](8.0)], sigma=0.0)
    block = driven(car, seconds=3.0)
    response = car.response(drive_of(block))
    torch.testing.assert_close(response.accel_measured[1:], block.accel[0, 1:], rtol=0, atol=1e-9)
    assert torch.equal(driven(plant([shown["MotorPower"].neutral()])).accel, driven(plant()).accel)
    time = torch.arange(200, dtype=torch.float64) * 0.1
    drives = [
        SimulatorInput(time, torch.full_like(time, 1.5), torch.full_like(time, speed)) for speed in (4.0, 8.0, 16.0)
    ]
    reached = [float(car.response(drive).accel[..., -1]) for drive in drives]
    # power over speed, once the lag is over; 1.5 where the bound is 2
    assert reached == pytest.approx([1.5, 1.0, 0.5], abs=1e-6)


def test_names_are_taken_once(shown: dict) -> None:
    from avtorch.gap import register

    with pytest.raises(InputError, match="another effect"):
        register(type("Other", (shown["Trailer"],), {}))
    assert effect_class("trailer") is shown["Trailer"]
