"""Which files are recordings, by content first; what is said where the library is not installed."""

from __future__ import annotations

import importlib
import importlib.util
import os
import subprocess
import sys
from pathlib import Path

import pytest

from avtorch.errors import InputError
from avtorch.io.formats import is_recording, kinds, open_recording

from .survival import refused

BEGINNINGS = {
    "MDF": (b"MDF     4.10    ", "drive.bin"),
    "unfinished MDF": (b"UnFinMF 4.10    ", "drive"),
    "ROS 1": (b"#ROSBAG V2.0\n", "drive.x"),
    "SQLite": (b"SQLite format 3\0", "drive.x"),
    "MCAP": (b"\x89MCAP0\r\n", "drive.x"),
    "Apollo": (bytes(8) + (64).to_bytes(8, "little") + b"\x08\x01\x10\0", "20261123.record.00007"),
    "BLF": (b"LOGG" + bytes(140), "drive.x"),
    "ASC": (b"date Mon Nov 23 13:00:00 2026\nbase hex  timestamps absolute\n", "drive.txt"),
    "ASC with a remark": (b"// made by hand\ndate Mon\nBase Hex timestamps absolute\n", "drive.txt"),
    "candump": (b"(1700000000.000000) can0 123#0011\n", "drive.log"),
    "MAT 5": (b"MATLAB 5.0 MAT-file, made by hand".ljust(124) + b"\0\1IM", "drive.x"),
    "MAT 7.3": (b"MATLAB 7.3 MAT-file, made by hand".ljust(124) + b"\0\2IM", "drive.x"),
    "HDF5 called MAT": (b"\x89HDF\r\n\x1a\n", "drive.MAT"),
    "Excel": (b"PK\x03\x04" + bytes(26) + b"[Content_Types].xml", "drive"),
    "Excel 97": (b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1", "drive"),
    "OpenDocument": (b"PK\x03\x04" + bytes(26) + b"mimetypeapplication/vnd.oasis.opendocument.spreadsheet", "drive"),
}
NONE = {
    "CSV": (b"time,speed\n0,1\n", "drive.csv"),
    "Parquet": (b"PAR1", "drive.parquet"),
    "empty": (b"", "drive.csv"),
    "log of another kind": (b"12:00 started\n", "drive.log"),
    "ZIP": (b"PK\x03\x04" + bytes(26) + b"photo.jpg", "photos.zip"),
    "HDF5": (b"\x89HDF\r\n\x1a\n", "drive.h5"),
    "CSV that speaks of a date": (b"date,base\n0,1\n", "drive.csv"),
}
SUFFIXES = (".mf4", ".bag", ".mcap", ".db3", ".record", ".blf", ".asc", ".mat", ".xlsx", ".xls", ".ods")


def put(folder: Path, content: bytes, name: str) -> Path:
    (folder / name).write_bytes(content)
    return folder / name


@pytest.mark.parametrize("case", BEGINNINGS)
def test_a_recording_is_known_by_how_it_begins(tmp_path: Path, case: str) -> None:
    path = put(tmp_path, *BEGINNINGS[case])
    assert is_recording(path)
    refused(path)  # there is nothing behind the beginning


@pytest.mark.parametrize("case", NONE)
def test_what_is_no_recording(tmp_path: Path, case: str) -> None:
    path = put(tmp_path, *NONE[case])
    assert not is_recording(path)
    with pytest.raises(InputError, match=r"is no recording; an MDF, ROS bag"):
        open_recording(path)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_name_that_promises_a_format_is_no_licence_to_guess(tmp_path: Path, suffix: str) -> None:
    path = put(tmp_path, b"\x01\x02 something else", f"drive{suffix}")
    assert is_recording(path)
    refused(path, "but its content is not; a file that begins with")
    refused(put(tmp_path, b"", f"none{suffix}"), "is empty")


def test_only_regular_files_and_bags_folders_are_opened(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.mf4")
    assert not is_recording(tmp_path / "pipe.mf4")
    refused(tmp_path / "pipe.mf4", "is no regular file")
    assert not is_recording(tmp_path)
    refused(tmp_path, "is a directory")
    assert not is_recording(tmp_path / "none.mf4")
    refused(tmp_path / "none.mf4", "no such file")
    assert not is_recording("/dev/zero")
    assert not is_recording(tmp_path / "a\0b.mf4")
    assert not is_recording(tmp_path / (300 * "x" + ".mf4"))


@pytest.mark.parametrize("kind", [kind for kind in kinds.KINDS if kind.extra], ids=lambda kind: kind.words)
def test_a_missing_library_is_one_command_away(kind: kinds.Kind, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(module: str) -> object:
        raise ModuleNotFoundError("No module named 'lxml'", name="lxml")

    monkeypatch.setattr(importlib, "import_module", broken)
    with pytest.raises(InputError, match=rf"reading it needs reader, .*lxml.*: pip install 'avtorch\[{kind.extra}\]'"):
        kinds.library("reader", "drive", kind)


def test_looking_at_a_file_loads_no_library(tmp_path: Path) -> None:
    for content, name in BEGINNINGS.values():
        put(tmp_path, content, name)
    code = (
        "import sys, os; from avtorch.io.formats import is_recording\n"
        "for n in os.listdir(sys.argv[1]): is_recording(os.path.join(sys.argv[1], n))\n"
        "print(*[m for m in ('asammdf', 'rosbags', 'can', 'cantools', 'h5py', 'python_calamine', 'torch')"
        " if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code, tmp_path], capture_output=True, text=True, check=True)
    assert done.stdout.split() == []
