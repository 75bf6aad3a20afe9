"""The paper's drive: one vehicle until the change, one noise for all settings, settings that act when they should."""

from __future__ import annotations

import pytest
import torch

from avtorch.decision.settings import Setting
from avtorch.paper.drive import ACT_S, drive, noise_seeds, rows_from, stacked
from avtorch.vehicle import Leader
from avtorch.vehicle.performance import rms_about_mean
from tests.bars import BAR

SETTINGS = stacked([Setting(scenarios=1), Setting(time_gap=2.0), Setting(1.33, 0.64, gains=(3.0, 3.0, -1.8))])


@pytest.mark.statistical
def test_settings_share_the_noise_and_part_at_the_action(rotating_seed: int) -> None:
    run = drive(Leader.default(), SETTINGS, seeds=2, seed=rotating_seed, duration=32.0)
    assert run.accel.shape == (3, 2, 3200)
    before = rows_from(run, 0.0, ACT_S + 0.005)
    assert torch.equal(before.accel[0], before.accel[1])
    assert torch.equal(before.accel[0], before.accel[2])
    assert not torch.equal(before.accel[0, 0], before.accel[0, 1])
    after = rows_from(run, ACT_S + 1.0)
    assert (after.accel[0] - after.accel[1]).abs().max() > 0.05
    assert (after.accel[0] - after.accel[2]).abs().max() > 0.05
    # the vehicle that follows the jerk law after the change is the changed one
    row = rows_from(run, 27.0, 28.0)
    noise = row.jerk - (0.5 * row.accel_cmd - row.accel) / 1.5
    # the standard error of an SD of 200 independent draws: settings share them
    assert float(noise.std()) == pytest.approx(0.1, rel=BAR / (2 * 200) ** 0.5)


def test_a_platoon_follows_itself() -> None:
    run = drive(Leader.default(), SETTINGS[:1], seeds=1, seed=0, duration=29.0, vehicles=3)
    assert run.speed.shape == (1, 1, 3, 2900)
    assert torch.equal(run.lead_speed[0, 0, 1], run.speed[0, 0, 0])


def test_seeds_of_neighbours_differ() -> None:
    assert not set(noise_seeds(0, 1000)) & set(noise_seeds(1, 1000))
    assert max(noise_seeds(2**63 - 1, 5)) < 2**63


def test_rms_about_mean() -> None:
    assert float(rms_about_mean(torch.tensor([1.0, 3.0]))) == pytest.approx(1.0)
