"""MAT files: version 5 by SciPy's writer, the same library as the reader; version 7.3 as MATLAB lays it out, by h5py.

Elements by hand test what no writer makes.
"""

from __future__ import annotations

import struct
from pathlib import Path

import h5py
import numpy as np
import pytest
from scipy.io import savemat

from avtorch.errors import InputError
from avtorch.io.formats import matlab, open_recording

from .survival import open_here, refused, survives

TIME = np.arange(150) * 0.01
SPEED = 12 + np.cos(TIME)
WHEELS = np.outer(SPEED, [1.0, 1.01, 0.99])  # no vector
LOG = {
    "log": {
        "time": TIME[:, None],
        "speed": SPEED[:, None],
        "wheel": WHEELS,
        "imu": {"t": TIME[::3], "accel": -SPEED[::3]},
        "cmd": {"Time": TIME[::2], "Data": SPEED[::2]},
        "engaged": TIME > 0.5,
        "driver": "someone",
    }
}
NAMES = ("log.speed", "log.imu.accel", "log.cmd", "log.engaged")


def mat5(path: Path, content: dict, **options: object) -> Path:
    savemat(path, content, **options)  # type: ignore[arg-type]
    return path


def mat73(path: Path, content: dict) -> Path:
    """MATLAB's layout: 512 bytes with its header, then HDF5; a struct is a group, a matrix is turned."""

    def put(group: h5py.Group, name: str, value: object) -> None:
        if isinstance(value, dict):
            inner = group.create_group(name)
            inner.attrs["MATLAB_class"] = np.bytes_("struct")
            for key, item in value.items():
                put(inner, key, item)
        elif isinstance(value, str):
            text = group.create_dataset(name, data=np.array([[ord(c)] for c in value], dtype=np.uint16))
            text.attrs["MATLAB_class"] = np.bytes_("char")
        else:
            array = np.atleast_2d(np.asarray(value))
            array = array.astype(np.uint8) if array.dtype == bool else array
            made = group.create_dataset(name, data=array.T, compression="gzip")
            made.attrs["MATLAB_class"] = np.bytes_("double" if array.dtype.kind == "f" else "logical")

    with h5py.File(path, "w", userblock_size=512) as file:
        for key, item in content.items():
            put(file, key, item)
    with path.open("r+b") as stream:
        stream.write(b"MATLAB 7.3 MAT-file, Platform: by hand".ljust(116) + bytes(8) + b"\0\2IM")
    return path


WRITERS = {"5": mat5, "7.3": mat73}


@pytest.mark.parametrize("version", WRITERS)
def test_structs_and_series(tmp_path: Path, version: str) -> None:
    recording = open_here(WRITERS[version](tmp_path / "drive.mat", LOG))
    assert recording.form == f"MAT {version}"
    assert set(recording.names) == set(NAMES)
    channels = recording.read(NAMES)
    assert channels["log.speed"].time.tolist() == TIME.tolist()
    assert channels["log.speed"].values.tolist() == SPEED.tolist()
    assert channels["log.imu.accel"].time.tolist() == TIME[::3].tolist()
    assert channels["log.imu.accel"].values.tolist() == (-SPEED[::3]).tolist()
    assert channels["log.cmd"].time.tolist() == TIME[::2].tolist()
    assert channels["log.cmd"].values.tolist() == SPEED[::2].tolist()
    assert channels["log.engaged"].values.tolist() == (TIME > 0.5).tolist()
    assert channels["log.engaged"].time is channels["log.speed"].time
    assert recording.remarks == ("left out, no time goes with them: log.wheel",)


@pytest.mark.parametrize("version", WRITERS)
def test_vectors_without_a_struct_and_a_time_in_milliseconds(tmp_path: Path, version: str) -> None:
    content = {"t_ms": np.arange(0.0, 100.0, 20.0), "speed": np.arange(5.0), "gain": 2.0, "other": np.arange(7.0)}
    recording = open_here(WRITERS[version](tmp_path / "drive.mat", content))
    assert recording.names == ("speed",)
    assert recording.read(["speed"])["speed"].time.tolist() == (np.arange(0.0, 100.0, 20.0) * 1e-3).tolist()
    assert recording.remarks == ("left out, no time goes with them: other",)


def test_an_array_of_structs_and_other_kinds_of_numbers(tmp_path: Path) -> None:
    cars = np.empty((1, 2), dtype=[("time", object), ("x", object)])
    cars[0, 0] = (TIME, np.arange(150, dtype=np.int16))
    cars[0, 1] = (TIME, np.arange(150, dtype=np.float32) / 4)
    recording = open_here(mat5(tmp_path / "drive.mat", {"car": cars, "z": TIME * 1j}))
    assert recording.names == ("car(1).x", "car(2).x")
    channels = recording.read(recording.names)
    assert channels["car(1).x"].values.tolist() == list(range(150))
    assert channels["car(2).x"].values.tolist() == (np.arange(150) / 4).tolist()


@pytest.mark.parametrize("version", WRITERS)
def test_a_file_without_a_time(tmp_path: Path, version: str) -> None:
    path = WRITERS[version](tmp_path / "drive.mat", {"speed": SPEED, "accel": SPEED})
    refused(path, "has no signal with a time; vectors without one: ", "speed", "called time, t, timestamp, timestamps")


def test_only_vectors_that_are_asked_for_are_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    recording = open_here(mat73(tmp_path / "drive.mat", LOG))
    read: list[str] = []
    vector = matlab.vector
    monkeypatch.setattr(matlab, "vector", lambda leaf: (read.append(leaf.name), vector(leaf))[1])
    recording.read(["log.speed", "log.engaged"])
    assert sorted(read) == ["/log/engaged", "/log/speed", "/log/time"]


def test_links_out_of_the_file_are_not_followed(tmp_path: Path) -> None:
    secret = mat73(tmp_path / "secret.mat", {"code": SPEED})
    path = mat73(tmp_path / "drive.mat", {"time": TIME, "speed": SPEED})
    with h5py.File(path, "r+") as file:
        file["outside"] = h5py.ExternalLink(str(secret), "/code")
        file["loop"] = h5py.SoftLink("/")
        file.create_dataset("raw", (150,), np.float64, external=[(str(secret), 0, 1200)])
    assert open_here(path).names == ("speed",)


def element(type_: int, content: bytes) -> bytes:
    return struct.pack("<II", type_, len(content)) + content + bytes(-len(content) % 8)


def matrix(class_: int, content: bytes = b"") -> bytes:
    head = element(6, struct.pack("<II", class_, 0)) + element(5, struct.pack("<ii", 1, 1)) + element(1, b"a")
    return element(14, head + content)


HEAD = b"MATLAB 5.0 MAT-file, by hand".ljust(124) + b"\0\1IM"


@pytest.mark.slow
def test_cells_within_cells_end(tmp_path: Path) -> None:
    """Two thousand deep: SciPy's reader leaves the stack of its process."""
    heads = [matrix(6)]
    for _ in range(2_000):
        heads.append(matrix(1, heads[-1]))
    (tmp_path / "drive.mat").write_bytes(HEAD + heads[-1])
    with pytest.raises(InputError, match=r"drive\.mat: .*needed"):
        open_recording(tmp_path / "drive.mat")


@pytest.mark.parametrize("compressed", [False, True])
def test_damage_to_version_5_is_read_or_refused(tmp_path: Path, compressed: bool, fresh_seed: int) -> None:
    path = mat5(tmp_path / "drive.mat", LOG, do_compression=compressed)
    survives(path, path.read_bytes(), fresh_seed, cuts=20, flips=60)


def test_damage_to_version_7_3_is_read_or_refused(tmp_path: Path, fresh_seed: int) -> None:
    path = mat73(tmp_path / "drive.mat", LOG)
    survives(path, path.read_bytes(), fresh_seed, cuts=10, flips=40)
