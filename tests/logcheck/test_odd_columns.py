"""Columns that only look like what they are taken for: codes, states, pedals, dead sensors, padded lines."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import avtorch
from avtorch.io import Log
from avtorch.io.validity import codes

from .drives import drive, written


@pytest.mark.parametrize(("signal", "code"), [("accel_cmd", 65535), ("accel", -999), ("speed", -999)])
def test_a_code_for_no_value_decides_no_unit(signal: str, code: int, tmp_path: Path, fresh_seed: int) -> None:
    """In 2 % of the rows: before, such a speed was in cm/s and the log of 7 s."""
    columns = drive(fresh_seed)
    coded = np.flatnonzero(np.random.default_rng(fresh_seed).random(3000) < 0.02)
    columns[signal][coded] = code
    found = avtorch.check(written(tmp_path / "drive.csv", columns))
    assert found.proposal is not None
    assert found.proposal.unit == {}
    assert found.log is not None
    assert found.log.rows == 3000 - len(coded)


def test_what_belongs_to_a_drive_is_no_code() -> None:
    quiet = np.concatenate([np.zeros(1000), np.linspace(0, -8, 40), np.linspace(-8, 0, 40)])
    assert not codes(quiet + 0.02 * np.random.default_rng(0).standard_normal(len(quiet))).any()
    assert not codes(np.repeat([0.0, 1.0], [970, 30])).any(), "a flag"
    assert not codes(np.array([1.0, np.nan, 400.0])).any(), "too few rows to tell"
    both = np.concatenate([np.linspace(0, 30, 1000), [-999.0, 65535.0]])
    assert codes(both).nonzero()[0].tolist() == [1000, 1001]


def test_on_and_off_say_who_drives(tmp_path: Path, fresh_seed: int) -> None:
    columns = drive(fresh_seed) | {"ACC_Status": ["on"] * 2000 + ["off"] * 1000}
    found = avtorch.check(written(tmp_path / "drive.csv", columns))
    assert found.proposal is not None
    assert found.proposal.map == {"engaged": "ACC_Status"}
    assert found.log is not None
    assert int(found.log.engaged.sum()) == 2000


def test_numbers_of_a_state_are_a_doubt(tmp_path: Path, fresh_seed: int) -> None:
    columns = drive(fresh_seed) | {"ACC_Status": ["4"] * 2000 + ["2"] * 1000}
    found = avtorch.check(written(tmp_path / "drive.csv", columns))
    assert found.proposal is not None
    assert "engaged" not in found.proposal.map
    (doubt,) = found.proposal.doubts
    assert doubt.startswith("ACC_Status (2, 4) may say when the controller drives")


def test_a_pedal_without_a_name_is_no_acceleration(tmp_path: Path, fresh_seed: int) -> None:
    d = drive(fresh_seed)
    columns = d | {"Pos_xy": [f"{x:.3f}" for x in (40 + 12 * d["accel_cmd"]).tolist()]}
    del columns["accel_cmd"]
    found = avtorch.check(written(tmp_path / "drive.csv", columns))
    assert found.proposal is not None
    assert "accel_cmd" not in found.proposal.map
    assert any("follows Pos_xy" in doubt and "throttle=COLUMN" in doubt for doubt in found.proposal.doubts)


def test_an_accelerometer_that_never_moves_is_left_out(tmp_path: Path, fresh_seed: int) -> None:
    """Before, an estimate from it had a lag of 105 s."""
    columns = drive(fresh_seed) | {"accel": ["0.0"] * 3000}
    path = written(tmp_path / "drive.csv", columns)
    log = Log.read(path)
    assert log.accel is None
    assert any("'accel' is 0 in every row" in note and "dead" in note for note in avtorch.io.check(log).notes)
    # a car that stands or cruises has nothing to notice
    steady = columns | {"speed": ["20.0"] * 3000}
    assert Log.read(written(tmp_path / "drive.csv", steady)).accel is not None


def test_lines_before_the_header_may_be_padded(tmp_path: Path, fresh_seed: int) -> None:
    columns = drive(fresh_seed)
    path = written(tmp_path / "drive.csv", columns, before="Recorder 7,,,\nDate,2026-01-01,,\n")
    assert avtorch.check(path).fault is None
    assert np.array_equal(Log.read(path).speed, drive(fresh_seed)["speed"])


def test_a_log_of_its_times_alone_is_asked_about(tmp_path: Path) -> None:
    (tmp_path / "drive.csv").write_text("\n".join(["time", *(f"{0.05 * i:.2f}" for i in range(400))]))
    found = avtorch.check(tmp_path / "drive.csv")
    assert found.log is None
    assert found.proposal is not None
    assert list(found.proposal.signals) == ["time"]
