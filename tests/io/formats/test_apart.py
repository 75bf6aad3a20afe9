"""Recordings that another process holds: the same answers, and one message when it ends."""

from __future__ import annotations

import subprocess
from pathlib import Path

import numpy as np
import pytest

from avtorch.errors import InputError
from avtorch.io.formats import apart, open_recording

from .survival import open_here
from .test_bags import mcap
from .test_can import DBC, candump
from .test_excel import LOG, patched, xlsx
from .test_matlab import LOG as STRUCTS
from .test_matlab import mat5, mat73
from .test_mdf import by_another

WRITERS = {
    "mf4": by_another,
    "mcap": mcap,
    "mat": lambda path: mat5(path, STRUCTS),
    "73.mat": lambda path: mat73(path, STRUCTS),
    "xlsx": lambda path: xlsx(path, {"notes": [["by hand"]], "log": [*LOG, [900.0, None, 0.5, "dry"]]}),
}


@pytest.mark.parametrize("form", WRITERS)
def test_the_answers_are_those_of_the_reader(tmp_path: Path, form: str) -> None:
    path = WRITERS[form](tmp_path / f"drive.{form}")
    there, here = open_recording(path), open_here(path)
    assert (there.source, there.form, there.names) == (here.source, here.form, here.names)
    assert (there.units, there.remarks) == (here.units, here.remarks)
    names = here.names[:0:-1]  # some of them, in an order of their own
    expected, found = here.read(names), there.read(names)
    assert tuple(found) == names
    for name in names:
        assert np.array_equal(found[name].time, expected[name].time)
        assert np.array_equal(found[name].values, expected[name].values, equal_nan=True)
        assert found[name].values.flags.writeable
    # those that share a clock there share it here
    assert len({id(c.time) for c in found.values()}) == len({id(c.time) for c in expected.values()})


@pytest.mark.parametrize("form", [*WRITERS, "log"])
def test_a_channel_that_is_not_there_and_more_samples_than_a_reader_takes(
    tmp_path: Path, form: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    if form == "log":
        (tmp_path / "drive.dbc").write_text(DBC)
    recording = open_here((WRITERS | {"log": candump})[form](tmp_path / f"drive.{form}"))
    with pytest.raises(InputError, match=r"drive\..*: channel 'sped' is missing; channels: "):
        recording.read(["sped"])
    samples = sum(len(channel.values) for channel in recording.read(recording.names).values())
    monkeypatch.setattr("avtorch.io.formats.listed.MOST_CELLS", samples)
    recording.read(recording.names)
    monkeypatch.setattr("avtorch.io.formats.listed.MOST_CELLS", samples - 1)
    what = f"has {samples:,} samples in the channels that are read; needs {samples - 1:,} at most"
    with pytest.raises(InputError, match=what):
        recording.read(recording.names)


@pytest.mark.slow
def test_what_the_reader_refuses_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "drive.mat"
    path.write_bytes(b"MATLAB 5.0 MAT-file, made by hand".ljust(124) + b"\0\1IM")
    with pytest.raises(InputError, match="has no signal with a time; a time vector is needed"):
        open_recording(path)
    recording = open_recording(mat5(path, STRUCTS))
    with pytest.raises(InputError, match=r"channel 'log.sped' is missing; channels: log.speed"):
        recording.read(["log.sped"])


@pytest.mark.slow
def test_odd_names_of_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("-c.mat", "größe\n;ls.mat"):
        mat5(tmp_path / name, STRUCTS)
        assert open_recording(Path(name)).names


def test_two_cells_that_claim_a_sheet_of_400_gb(tmp_path: Path) -> None:
    """python-calamine ends its process here, which is not this one."""
    path = xlsx(tmp_path / "drive.xlsx", {"a": [["t", "x"], [0.0, 1.0], [1.0, 2.0]]})
    patched(path, "sheet1.xml", lambda raw: raw.replace(b'r="B3"', b'r="XFD1048576"').replace(b'r="3"', b'r="1048576"'))
    with pytest.raises(InputError, match=r"it ended the process that read it \(SIGABRT\); an undamaged Excel file"):
        open_recording(path)


def test_a_process_that_takes_too_long(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(apart, "MOST_SECONDS", 0.001)
    with pytest.raises(InputError, match=r"is not read within .* s; a smaller or an undamaged file is needed"):
        open_recording(mat5(tmp_path / "drive.mat", STRUCTS))


def test_no_process_can_be_started(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(apart.sys, "executable", str(tmp_path / "no python"))
    with pytest.raises(InputError, match=r"drive\.mat: no process can be started to read it"):
        open_recording(mat5(tmp_path / "drive.mat", STRUCTS))


def test_what_is_asked_for_comes_along(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    recording = open_recording(mat5(tmp_path / "drive.mat", STRUCTS), ["log.speed", "log.engaged", "none"])
    monkeypatch.setattr(subprocess, "run", None)
    assert list(recording.read(["log.engaged", "log.speed"])) == ["log.engaged", "log.speed"]
