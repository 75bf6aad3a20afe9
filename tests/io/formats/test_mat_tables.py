"""MATLAB's tables and timetables, in files that mat-io writes: the only other program that knows their layout."""

from __future__ import annotations

import importlib.util
import warnings
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from avtorch.errors import InputError
from avtorch.io import Log
from avtorch.io.formats import open_recording

with warnings.catch_warnings():  # it sets an option of pandas that is no longer needed
    warnings.simplefilter("ignore")
    import matio

TIME = np.arange(150) / 30
COMMAND, SPEED = np.sin(TIME), 20 + np.cos(TIME)


def written(path: Path, version: str, **content: object) -> Path:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        matio.save_to_mat(str(path), content, version=version)
    return path


def timetable() -> pd.DataFrame:
    index = pd.to_timedelta((TIME * 1e9).round().astype(np.int64), unit="ns")
    return pd.DataFrame({"AccReq": COMMAND, "VehSpd": SPEED, "driver": "someone"}, index=index.rename("Time"))


@pytest.mark.usefixtures("in_this_process")
@pytest.mark.parametrize("version", ["v7", pytest.param("v7.3", marks=pytest.mark.slow)])
def test_a_timetable_has_its_own_time(tmp_path: Path, version: str) -> None:
    file = written(tmp_path / "drive.mat", version, drive=timetable())
    found = open_recording(file)
    assert sorted(found.names) == ["drive.AccReq", "drive.VehSpd"]
    log = Log.read(file, map={"accel_cmd": "drive.AccReq", "speed": "drive.VehSpd"})
    assert log.accel_cmd is not None
    assert log.speed is not None
    # times are whole nanoseconds
    assert log.elapsed == pytest.approx(TIME, abs=1e-8)
    assert np.array_equal(log.accel_cmd, COMMAND)
    assert np.array_equal(log.speed, SPEED)


@pytest.mark.usefixtures("in_this_process")
@pytest.mark.parametrize("version", ["v7", pytest.param("v7.3", marks=pytest.mark.slow)])
def test_a_table_has_the_time_among_its_columns_beside_what_is_no_table(tmp_path: Path, version: str) -> None:
    table = pd.DataFrame({"time": TIME, "accel_cmd": COMMAND})
    file = written(tmp_path / "drive.mat", version, t1=table, other={"t": TIME[:, None], "speed": SPEED[:, None]})
    assert {"t1.accel_cmd", "other.speed"} <= set(open_recording(file).names)


def test_without_the_library_it_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from avtorch.io.formats import matlab

    real = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "matio" else real(name))
    trees, remarks = matlab._tables(tmp_path / "drive.mat", [])
    assert trees == {}
    assert remarks == ["its tables and other objects are left out; tables need mat-io: pip install 'avtorch[mat]'"]


def test_a_damaged_table_does_not_lose_the_rest(tmp_path: Path) -> None:
    from avtorch.io.formats import matlab

    (tmp_path / "drive.mat").write_bytes(b"MATLAB 5.0 MAT-file".ljust(200, b"\0"))
    trees, remarks = matlab._tables(tmp_path / "drive.mat", [])
    assert trees == {}
    assert remarks[0].startswith("its tables and other objects are left out, mat-io cannot read them: ")


@pytest.mark.slow
def test_a_table_without_time_is_told(tmp_path: Path) -> None:
    file = written(tmp_path / "drive.mat", "v7", drive=pd.DataFrame({"accel_cmd": COMMAND}))
    with pytest.raises(InputError, match=r"has no signal with a time; vectors without one: drive\.accel_cmd"):
        open_recording(file)
