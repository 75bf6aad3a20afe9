"""MDF: files of a writer in another language (mf4-rs), and of asammdf's own for what that one does not write."""

from __future__ import annotations

import random
import struct
from pathlib import Path

import numpy as np
import pytest
from asammdf import MDF, Signal
from mf4_rs import MdfWriter, create_float_value, create_uint_value

from avtorch.errors import InputError
from avtorch.io.formats import apart, open_recording

from .survival import open_here, refused, survive, survives

TIME = np.arange(200) * 0.02
SPEED = 20 + np.sin(TIME)


def by_another(path: Path, groups: tuple[str, ...] = ("chassis", "imu")) -> Path:
    """Two groups that both have a speed, one of them also a counter of 8 bits."""
    writer = MdfWriter(str(path))
    writer.init_mdf_file()
    made = []
    for name in groups:
        group = writer.add_channel_group(name)
        writer.add_time_channel(group, "t")
        writer.add_float_channel(group, "speed")
        writer.add_int_channel(group, f"count_{name}")
        made.append(group)
    for k, group in enumerate(made):
        writer.start_data_block(group)
        for i in range(len(TIME)):
            numbers = create_float_value(TIME[i] + k), create_float_value(SPEED[i] * (k + 1)), create_uint_value(i)
            writer.write_record(group, list(numbers))
        writer.finish_data_block(group)
    writer.finalize()
    return path


def by_asammdf(path: Path, signals: list[Signal], version: str = "4.10") -> Path:
    with MDF(version=version) as mdf:
        mdf.append(signals)
        return Path(mdf.save(path, overwrite=True))


def test_values_and_stamps_of_another_writer_come_back_exactly(tmp_path: Path) -> None:
    recording = open_here(by_another(tmp_path / "drive.mf4"))
    assert recording.form.startswith("MDF 4.")
    assert recording.names == ("chassis.speed", "count_chassis", "imu.speed", "count_imu")
    channels = recording.read(recording.names)
    assert channels["chassis.speed"].values.tolist() == SPEED.tolist()
    assert channels["imu.speed"].values.tolist() == (2 * SPEED).tolist()
    assert channels["imu.speed"].time.tolist() == (TIME + 1).tolist()
    assert channels["count_imu"].values.tolist() == list(range(200))
    assert channels["count_imu"].time is channels["imu.speed"].time


def test_groups_of_one_name_are_told_apart_by_number(tmp_path: Path) -> None:
    recording = open_here(by_another(tmp_path / "drive.mf4", ("imu", "imu")))
    assert recording.names == ("0.speed", "0.count_imu", "1.speed", "1.count_imu")


@pytest.mark.parametrize("version", ["3.30", "4.10"])
def test_units_conversions_and_texts(tmp_path: Path, version: str) -> None:
    """A linear conversion is applied; a channel whose values all have texts is read as its numbers; texts are left."""
    counts = np.arange(200, dtype=np.uint16)
    signals = [
        Signal(SPEED, TIME, name="speed", unit="km/h"),
        Signal(counts, TIME, name="accel", unit="m/s2", conversion={"a": 0.01, "b": -3.0}),
        Signal(
            (counts % 3).astype(np.uint8),
            TIME,
            name="state",
            conversion={"val_0": 0, "text_0": b"off", "val_1": 1, "text_1": b"on", "val_2": 2, "text_2": b"fault"},
        ),
        Signal(np.array([b"word"] * 200), TIME, name="note", encoding="utf-8"),
    ]
    recording = open_here(by_asammdf(tmp_path / "drive.mdf", signals, version))
    assert recording.form == f"MDF {version}"
    assert recording.names == ("speed", "accel", "state")
    assert dict(recording.units) == {"speed": "km/h", "accel": "m/s2"}
    channels = recording.read(recording.names)
    assert channels["speed"].values.tolist() == SPEED.tolist()
    assert channels["speed"].time.tolist() == TIME.tolist()
    assert channels["state"].values.tolist() == (np.arange(200) % 3).tolist()
    # 0.01 n - 3 in another order of operations: each of two roundings is at most half of 2^-52 of up to 3
    assert np.abs(channels["accel"].values - (0.01 * counts - 3.0)).max() <= 2 * 3 * 2**-52


def test_texts_for_a_few_values_leave_the_others_numbers(tmp_path: Path) -> None:
    counts = np.arange(200, dtype=np.uint8)
    signal = Signal(
        counts,
        TIME,
        name="speed",
        conversion={
            "lower_0": 150, "upper_0": 255, "text_0": b"not available",
            "default_addr": {"a": 0.5, "b": 0.0},
        },
    )  # fmt: skip
    channel = open_here(by_asammdf(tmp_path / "drive.mf4", [signal])).read(["speed"])["speed"]
    assert channel.values[:150].tolist() == (counts[:150] / 2).tolist()
    assert np.isnan(channel.values[150:]).all()


def test_samples_marked_invalid_are_nan_and_stay_in_their_place(tmp_path: Path) -> None:
    invalid = np.arange(200) % 7 == 0
    signals = [Signal(SPEED, TIME, name="speed", invalidation_bits=invalid)]
    channel = open_here(by_asammdf(tmp_path / "drive.mf4", signals)).read(["speed"])["speed"]
    assert channel.time.tolist() == TIME.tolist()
    assert np.isnan(channel.values).tolist() == invalid.tolist()
    assert channel.values[~invalid].tolist() == SPEED[~invalid].tolist()


def test_only_channels_that_are_asked_for_are_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    read: list[tuple[int, int]] = []
    get = MDF.get

    def spied(self: MDF, *args: object, **options: object) -> object:
        read.append((options["group"], options["index"]))  # type: ignore[arg-type]
        return get(self, *args, **options)  # type: ignore[arg-type]

    monkeypatch.setattr(MDF, "get", spied)
    recording = open_here(by_another(tmp_path / "drive.mf4"))
    assert read == []
    assert list(recording.read(["imu.speed"])) == ["imu.speed"]
    assert read == [(1, 1)]
    assert recording.read([]) == {}


def blocks(raw: bytes, name: bytes) -> list[int]:
    found, at = [], raw.find(b"##" + name)
    while at >= 0:
        found.append(at)
        at = raw.find(b"##" + name, at + 1)
    return found


@pytest.mark.slow
@pytest.mark.parametrize("name", [b"DG", b"CG", b"CN"])
def test_a_chain_that_returns_to_itself_ends(tmp_path: Path, name: bytes, monkeypatch: pytest.MonkeyPatch) -> None:
    """asammdf follows it until the process has no time or no memory left."""
    path = by_another(tmp_path / "drive.mf4")
    raw = bytearray(path.read_bytes())
    at = blocks(raw, name)[0]
    raw[at + 24 : at + 32] = struct.pack("<Q", at)
    path.write_bytes(raw)
    monkeypatch.setattr(apart, "MOST_SECONDS", 10.0)
    with pytest.raises(InputError, match=r"drive\.mf4: .* is needed"):
        open_recording(path)


def test_a_compressed_piece_that_claims_the_impossible(tmp_path: Path) -> None:
    with MDF(version="4.10") as mdf:
        mdf.append([Signal(np.zeros(100_000), np.arange(100_000) / 100, name="speed")])
        path = Path(mdf.save(tmp_path / "drive.mf4", compression=1))
    raw = bytearray(path.read_bytes())
    assert open_here(path).read(["speed"])["speed"].values.tolist() == [0.0] * 100_000
    at = blocks(raw, b"DZ")[0]
    raw[at + 32 : at + 40] = struct.pack("<Q", 2**40)
    path.write_bytes(raw)
    refused(path)


def test_the_whole_groups_of_a_file_that_is_cut_off_are_read(tmp_path: Path) -> None:
    """mf4-rs writes the blocks before the samples, as recorders do."""
    path = by_another(tmp_path / "drive.mf4")
    raw = path.read_bytes()
    data = blocks(raw, b"DT")[-1]
    path.write_bytes(raw[: data + 24 + 100 * 24 + 5])
    recording = open_here(path)
    assert recording.remarks == ("the file is cut off; blocks that its end cuts are left out",)
    channels = recording.read(["chassis.speed", "imu.speed"])
    assert channels["chassis.speed"].values.tolist() == SPEED.tolist()
    assert channels["imu.speed"].values.tolist() == []


@pytest.mark.parametrize("version", ["3.30", "4.10", "other"])
def test_damage_is_read_or_refused(tmp_path: Path, version: str, fresh_seed: int) -> None:
    path = tmp_path / "drive.mf4"
    signals = [Signal(SPEED, TIME, name="speed", unit="m/s"), Signal(np.arange(200), TIME, name="count")]
    whole = by_another(path) if version == "other" else by_asammdf(path, signals, version)
    survives(path, whole.read_bytes(), fresh_seed, cuts=10, flips=25)


def test_the_links_of_damaged_blocks_are_read_or_refused(tmp_path: Path, fresh_seed: int) -> None:
    """Damage where it hurts: a link, a size or a count becomes any other number of the file."""
    path = by_another(tmp_path / "drive.mf4")
    raw, rng = path.read_bytes(), random.Random(fresh_seed)
    heads = [at for name in (b"HD", b"DG", b"CG", b"CN", b"DT", b"TX") for at in blocks(raw, name)]
    contents = []
    for _ in range(40):
        content, at = bytearray(raw), rng.choice(heads) + 8 * rng.randrange(1, 8)
        number = rng.choice([*heads, 0, 1, rng.randrange(len(raw)), 2**63, 2**32 - 1])
        content[at : at + 8] = struct.pack("<Q", number)
        contents.append(bytes(content))
    survive(path, contents)
