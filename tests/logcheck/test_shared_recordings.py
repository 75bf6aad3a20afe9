"""Recordings of real cars: their own names are kept, and cars that follow are known as such."""

from __future__ import annotations

from pathlib import Path

import pytest

import avtorch

COMMANDED = {
    "genesis/lap1.csv", "indy_av21/Putnam_park2023_run4_2.csv", "roboracer/Normal_1weight.csv",
    "roboracer/single_mass.csv", "roboracer/tire_set_1.csv", "roboracer/ftg_stanley_total_training.csv",
    "roboracer/ftg_stanley_total_validation.csv", "dart/09_16_2024_10_02_28_onboard10Hz.csv",
    "dart/09_16_2024_10_27_02_vicon50Hz.csv", "volvo_truck/052311_grade.csv",
}  # fmt: skip


@pytest.mark.parametrize("name", sorted(COMMANDED))
def test_a_log_with_avtorchs_names_needs_no_mapping(data_dir: Path, name: str) -> None:
    found = avtorch.check(data_dir / name)
    assert found.fault is None
    assert found.proposal is not None
    assert not found.proposal.needed, found.proposal
    assert not any("current_A" in doubt for doubt in found.proposal.doubts)  # amperes, and no acceleration
    assert found.excitation


@pytest.mark.parametrize(
    "folder", ["openacc_astazero", "openacc_zalazone", pytest.param("ngsim", marks=pytest.mark.slow)]
)
def test_platoons_without_commands_are_told(data_dir: Path, folder: str) -> None:
    first = next(path for path in sorted((data_dir / folder).glob("*.csv")) if path.name != "Slope.csv")
    found = avtorch.check(first)
    assert found.follows
    assert found.log is not None
    assert found.log.accel_cmd is None


def test_what_the_accelerometer_of_i24_leaves_open_is_told(data_dir: Path) -> None:
    """It reads 1.8 times what the speed in km/h makes of it, as it would if that were miles an hour."""
    found = [avtorch.check(path) for path in sorted((data_dir / "i24").glob("*.csv"))]
    proposals = [one.proposal for one in found if not one.follows and one.proposal is not None]
    assert len(proposals) == 3
    assert all(any("speed in km/h" in doubt for doubt in proposal.doubts) for proposal in proposals)
