"""The page on own effects, docs/own-effect.md: its code runs and does what the page states.

One class in one file is all that an effect takes to drive, and to be among the candidates of a diagnosis.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import torch

import avtorch
from avtorch.errors import InputError
from avtorch.gap import EFFECTS, Effect, GapPlant, SimulatorInput, plant
from avtorch.gap.simulator.effect import effect_class
from tests.gap.drives import drive_of, driven
from tests.gap.records import log_of

PAGE = Path(__file__).resolve().parents[3] / "docs" / "own-effect.md"
BLOCKS = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.S)


@contextmanager
def defined(blocks: Iterable[str]) -> Iterator[dict]:
    """What blocks of the page define; the registry is as before afterwards."""
    before, names = dict(EFFECTS), {}
    try:
        for block in blocks:
            exec(compile(block, "own-effect.md", "exec", dont_inherit=True), names)
        yield names
    finally:
        EFFECTS.clear()
        EFFECTS.update(before)


@pytest.fixture
def shown() -> Iterator[dict]:
    """What the page's code defines, but for its diagnoses."""
    assert len(BLOCKS) >= 3
    assert len([line for line in BLOCKS[0].splitlines() if line.strip()]) <= 20
    with defined(block for block in BLOCKS if "diagnose(" not in block) as names:
        yield names


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


# among the candidates of a diagnosis --------------------------------------------------------------------------------
@pytest.mark.slow
def test_one_of_each_kind_is_named_by_the_pages_own_code(capsys: pytest.CaptureFixture[str]) -> None:
    with defined(BLOCKS) as names:
        pass
    said = capsys.readouterr().out
    # nats over none; the noise is that of one seed
    for key, effect, least in (("weak", "motor_power", 60), ("hot", "hot_motor", 14), ("found", "crosstalk", 550)):
        found = names[key]
        assert f"{effect} has probability" in said
        assert found.verdict.names == (effect,)
        assert least < (found.winner.log_evidence or 0.0) < 4 * least
        assert found.plant is not None
        assert f"[{effect}]" in found.plant.to_toml()
    fade = names["hot"].winner.parameters["fade"]
    assert abs(fade.mean - 0.15) < 5 * fade.sd
    noise = names["found"].plant.effects[0].noise_sd
    assert noise != 0.02  # the log's, not the class's
    assert noise == pytest.approx(0.02, rel=0.1)


@pytest.mark.slow
@pytest.mark.statistical
def test_it_leads_and_is_measured(shown: dict, rotating_seed: int) -> None:
    log = log_of(plant([shown["Trailer"](0.4)], T_L=0.4), seconds=40.0, rng=np.random.default_rng(rotating_seed))
    found = avtorch.diagnose(log, effects=["trailer", "dead_time", "sensor_scale", "sensor_bias"], pairs=False)
    evidence = {c.name: c.log_evidence for c in found.candidates if c.log_evidence is not None}
    # some 60 nats more; none of the others can pull less and brake as before
    assert evidence.pop("trailer") > max(evidence.values()) + 15
    told = next(c for c in found.candidates if c.name == "trailer")
    assert told.probability == max(c.probability for c in found.candidates if c.name != "unknown")
    ratio = told.parameters["mass_ratio"]
    assert abs(ratio.mean - 0.4) < 6 * ratio.sd


def test_without_registration_it_is_handed_over(shown: dict) -> None:
    EFFECTS.pop("trailer")
    log = log_of(plant([shown["Trailer"](0.4)], T_L=0.4), seconds=20.0, rng=np.random.default_rng(6))
    found = avtorch.diagnose(log, effects=[shown["Trailer"], "dead_time"], pairs=False)
    assert {c.name for c in found.candidates} <= {"trailer", "dead_time", "none", "unknown"}
    assert found.probability("trailer") > found.probability("dead_time")
