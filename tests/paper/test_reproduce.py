"""All from one call, and what its experiments share: rows and their verdicts, leaders, the drive."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import torch

from avtorch.decision.settings import Setting
from avtorch.errors import InputError
from avtorch.paper import EXPERIMENTS, Leaders, reproduce
from avtorch.paper.drive import ACT_S, drive, noise_seeds, rows_from, stacked
from avtorch.paper.leaders import DRIVE_S, PLATOON_S, SWEEP_S
from avtorch.paper.rows import ClaimRow, error, median_interval, number_list, share, sign, spread, within
from avtorch.vehicle import Leader
from avtorch.vehicle.performance import rms_about_mean
from tests.bars import BAR


@pytest.mark.slow
def test_equal_by_seed_and_only_by_seed() -> None:
    told: list[tuple[float, float]] = []
    first, again, other = (
        reproduce(["gains"], seeds=2, seed=seed, progress=lambda done, of: told.append((done, of))).answer()
        for seed in (4, 4, 5)
    )
    assert first == again
    assert first["rows"] != other["rows"]
    assert told[-1][0] == told[-1][1]
    assert first["schema"] == "avtorch.paper/1"
    assert first["leaders"] == {"US06": "US06, the embedded drive cycle, from its start"}
    assert {row["verdict"] for row in first["rows"]} <= {"same", "better", "not reproduced"}
    assert all(row["why"].endswith(".") for row in first["rows"])


@pytest.mark.slow
def test_belief_and_action_are_equal_by_seed() -> None:
    first, again = (reproduce(["platoon"], seeds=2, seed=9) for _ in range(2))
    assert list(first.found) == ["platoon"]
    assert first.answer() == again.answer()


def test_refusals() -> None:
    with pytest.raises(InputError, match=f"needs some of {', '.join(EXPERIMENTS)}"):
        reproduce(["gain"])
    with pytest.raises(InputError, match="seeds: found 1, needs 2 or more"):
        reproduce(["gains"], seeds=1)


# Verdicts come from figures by the rules that the module states, and intervals hold what they promise.
def test_rules() -> None:
    assert error(0.17, (0.05, 0.16)) == "better"
    assert error(0.17, (0.05, 0.17)) == "same"
    assert error(0.17, (0.18, 0.3)) == "not reproduced"
    assert sign((0.1, 0.9), above=0.0) == "same"
    assert sign((-0.1, 0.9), above=0.0) == "not reproduced"
    assert sign((0.96, 1.04), above=0.95, below=1.05) == "same"
    assert sign(1.0, below=1.0) == "not reproduced"
    assert (share(0.95), share(0.94)) == ("same", "not reproduced")
    assert (within(0.9, 0.85, 0.95), within(0.96, 0.85, 0.95)) == ("same", "not reproduced")


def test_what_is_not_finite_is_never_the_same() -> None:
    assert sign((math.nan, math.nan), below=1.0) == "not reproduced"
    assert error(0.1, (math.nan, math.nan)) == "not reproduced"


@pytest.mark.statistical
def test_intervals_hold_the_truth_as_often_as_they_say(rotating_seed: int, draws_factor: int) -> None:
    trials, runs = 400 * draws_factor, 40
    generator = torch.Generator().manual_seed(rotating_seed)
    values = torch.randn(trials, runs, generator=generator, dtype=torch.float64)
    held = sum(low <= 0.0 <= high for low, high in (median_interval(v, i) for i, v in enumerate(values)))
    # a bootstrap of 40 values holds some 88 %; five standard errors of 400 trials are 7.5 points
    assert 0.80 < held / trials < 0.985


def test_spread_and_words() -> None:
    assert spread(torch.arange(101.0)) == (5.0, 95.0)
    assert number_list([0.1, 0.2, 3.0]) == "0.1, 0.2 and 3"
    assert number_list([2.5]) == "2.5"
    row = ClaimRow("gains", "s", "q", 1.0, 2.0, (1.0, 3.0), "same", "w.").as_dict()
    assert row["interval"] == [1.0, 3.0]
    assert list(row) == ["name", "setting", "quantity", "paper", "ours", "interval", "verdict", "why"]


# Recordings where there are some, US06 where there are none, one line where the folder is not what it should be.
def test_without_recordings_us06_is_reported() -> None:
    leaders = Leaders.read()
    assert [a.name for a in (*leaders.sweep, *leaders.drives)] == ["US06", "US06"]
    assert leaders.main.with_note("As it is.") == (
        "As it is; no recordings were given, so the embedded US06 drives ahead."
    )
    assert leaders.main.leader.duration >= PLATOON_S


def test_what_is_missing_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="is not a folder"):
        Leaders.read(tmp_path / "none")
    with pytest.raises(InputError, match=r"has no ngsim/events_000_249\.csv"):
        Leaders.read(tmp_path)


def test_recordings(data_dir: Path) -> None:
    leaders = Leaders.read(data_dir)
    assert all(a.leader.duration >= SWEEP_S and not a.note for a in leaders.sweep)
    assert all(a.leader.duration >= DRIVE_S for a in leaders.drives)
    assert leaders.main.leader.duration >= PLATOON_S
    assert list(leaders.descriptions) == ["NGSIM 156", "OpenACC ZalaZONE", "OpenACC AstaZero"]
    assert leaders.descriptions["NGSIM 156"].startswith("event 156, 50.2 s")


# The paper's drive: one vehicle until the change, one noise for all settings, settings that act when they should.
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
