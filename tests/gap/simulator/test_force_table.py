"""A force table and a resistance in a plant: text, steps of other lengths, and whole drives."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from avtorch.errors import InputError
from avtorch.gap import DeadTime, ForceTable, GapPlant, ResistanceCurve, SimulatorInput, plant
from avtorch.remedy import to_autoware, to_openpilot, write_exports
from avtorch.remedy.exports import ACCELERATION_MAP

TABLE = ForceTable((-2.0, 0.0, 2.0), (0.0, 20.0), ((0.5, 0.2), (0.0, 0.0), (-0.4, -1.0)))
CURVE = ResistanceCurve((0.0, 10.0, 30.0), (-0.1, -0.2, -0.8))
CAR = plant([TABLE, CURVE, DeadTime(0.25)], T_L=0.4, K_L=0.8, sigma=0.0)


def scalar(x: float) -> torch.Tensor:
    return torch.tensor(x, dtype=torch.float64)


def driven(car: GapPlant, dt: float, seconds: float = 12.0) -> np.ndarray:
    """Speeds at whole seconds from 10 m/s on, by steps of `dt`; the command changes with whole seconds."""
    car.reset()
    a, v, out = scalar(0.0), scalar(10.0), []
    for k in range(round(seconds / dt)):
        u = scalar(1.5 * np.sin(np.floor(k * dt + 1e-9)))
        a, v, _ = car.step(a, v, u, dt, scalar(0.0))
        if abs((k + 1) * dt - round((k + 1) * dt)) < 1e-9:
            out.append(float(v))
    return np.array(out)


def test_a_table_is_linear_between_knots_and_held_outside() -> None:
    u, v = torch.tensor([1.0, 1.0, 9.0, -9.0]).double(), torch.tensor([0.0, 10.0, 99.0, -1.0]).double()
    assert TABLE.force(u, v).tolist() == pytest.approx([-0.2, -0.35, -1.0, 0.5])


def test_the_plant_comes_back_from_its_text_and_drives_alike_at_other_steps() -> None:
    again = GapPlant.from_toml(CAR.to_toml())
    assert again.to_toml() == CAR.to_toml()
    fine = driven(CAR, 0.01, 2.0)
    for dt, error in ((0.02, 0.01), (0.1, 0.05)):
        assert driven(again, dt, 2.0) == pytest.approx(fine, abs=error)


def test_a_drive_by_steps_is_the_whole_drive() -> None:
    dt, rows = 0.02, 500
    time = dt * np.arange(rows)
    command = np.sin(time)
    CAR.reset()
    a, v, speeds = scalar(0.0), scalar(10.0), [10.0]
    for u in command[:-1].tolist():
        a, v, _ = CAR.step(a, v, scalar(u), dt, scalar(0.0))
        speeds.append(float(v))
    drive = SimulatorInput(torch.as_tensor(time), torch.as_tensor(command), torch.tensor(speeds), 0.0)
    assert CAR.response(drive).speed.tolist() == pytest.approx(speeds, abs=2e-3)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[force_map]\ncommand_mps2 = [0.0, 1.0]\nspeed_mps = [0.0, 1.0]\nforce_mps2 = [[0.0, 0.0]]", "a row for each"),
        ("[force_map]\ncommand_mps2 = [1.0, 0.0]\nspeed_mps = [0.0, 1.0]\nforce_mps2 = [[0.0], [0.0]]", "that rise"),
        ("[force_map]\nforce_mps2 = 3.0", "needs a list of lists"),
        ("[resistance_curve]\nspeed_mps = [0.0, 1.0]\nforce_mps2 = [0.0, 1.0, 2.0]", "one for each"),
    ],
)
def test_a_table_that_does_not_fit_is_refused(text: str, said: str) -> None:
    with pytest.raises(InputError, match=said):
        GapPlant.from_toml(text)


def test_a_tool_that_has_no_such_table_says_so() -> None:
    assert any("force_map" in line for line in to_openpilot(CAR).to_text().splitlines())


def test_autoware_is_given_the_accelerations_that_follow(tmp_path: Path) -> None:
    write_exports(CAR, tmp_path)
    rows = [line.split(",") for line in (tmp_path / ACCELERATION_MAP).read_text().splitlines()]
    assert rows[0] == ["default", "0", "20"]
    assert [float(x) for x in rows[-1]] == pytest.approx([2.0, 1.6 - 0.4 - 0.1, 1.6 - 1.0 - 0.5])
    assert ACCELERATION_MAP in to_autoware(CAR).to_text()
    assert "force_map" not in to_autoware(CAR).to_text()
