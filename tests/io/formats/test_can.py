"""CAN logs: candump and ASC by hand and BLF by python-can's writer, the reader's own library; no other one writes BLF.

The frames are packed by hand from the database's layout, not by the library that decodes them.
"""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import can
import numpy as np
import pytest

from avtorch.errors import InputError
from avtorch.io.formats import apart, open_recording

from .survival import open_here, refused, survives

DBC = """VERSION ""

NS_ :

BS_:

BU_: ECU

BO_ 256 Chassis: 8 ECU
 SG_ Speed : 0|16@1+ (0.01,0) [0|655.35] "km/h" ECU
 SG_ Accel : 16|16@1- (0.002,-1) [-66|66] "m/s2" ECU

BO_ 512 Pedals: 4 ECU
 SG_ Page M : 0|8@1+ (1,0) [0|255] "" ECU
 SG_ Throttle m0 : 8|8@1+ (0.5,0) [0|100] "%" ECU
 SG_ Brake m1 : 8|8@1+ (0.5,0) [0|100] "%" ECU

BO_ 2566844926 Adas: 8 ECU
 SG_ Command : 7|16@0- (0.001,0) [-32|32] "m/s2" ECU
 SG_ Mode : 16|2@1+ (1,0) [0|3] "" ECU

BO_ 768 Silent: 8 ECU
 SG_ Never : 0|8@1+ (1,0) [0|255] "" ECU

VAL_ 2566844926 Mode 0 "off" 1 "on" ;
"""
COUNT = 300
NUMBERS = np.arange(COUNT)
NAMES = (
    "Chassis.Speed", "Chassis.Accel", "Pedals.Page", "Pedals.Throttle", "Pedals.Brake", "Adas.Command", "Adas.Mode",
)  # fmt: skip


def frames() -> list[tuple[int, bool, bytes]]:
    """Identifier, whether it is an extended one, and data, one line of frames for every 10 ms."""
    found = []
    for n in range(COUNT):
        found.append((0x100, False, struct.pack("<HhI", 2 * n, 500 - n, 0)))
        found.append((0x200, False, bytes((n % 2, n % 200, 0, 0))))
        found.append((0x18FEF1FE, True, struct.pack(">hB", n - 150, n % 2) + bytes(5)))
    return found


def stamps(every: int) -> np.ndarray:
    """Microseconds of the frames of one message, of three that share 10 ms."""
    return NUMBERS * 10_000 + every * 1_000


def candump(path: Path, bus: str = "can0") -> Path:
    lines = []
    for i, (number, extended, data) in enumerate(frames()):
        micro = i // 3 * 10_000 + i % 3 * 1_000
        name = f"{number:08X}" if extended else f"{number:03X}"
        lines.append(f"({1_700_000_000 + micro // 10**6}.{micro % 10**6:06d}) {bus} {name}#{data.hex().upper()}\n")
    path.write_text("".join(lines))
    return path


def asc(path: Path) -> Path:
    lines = ["date Mon Nov 23 13:00:00.000 2026\n", "base hex  timestamps absolute\n", "no internal events logged\n"]
    lines.append("Begin Triggerblock Mon Nov 23 13:00:00.000 2026\n")
    for i, (number, extended, data) in enumerate(frames()):
        micro = i // 3 * 10_000 + i % 3 * 1_000
        name = f"{number:X}x" if extended else f"{number:X}"
        lines.append(f"{micro / 1e6:11.6f} 1  {name:15} Rx   d {len(data)} {data.hex(' ').upper()}\n")
    path.write_text("".join(lines) + "End TriggerBlock\n")
    return path


def blf(path: Path) -> Path:
    with can.BLFWriter(str(path)) as writer:
        writer.max_container_size = 2048  # several containers, frames across their borders
        for i, (number, extended, data) in enumerate(frames()):
            stamp = 1_700_000_000 + (i // 3 * 10_000 + i % 3 * 1_000) / 1e6
            writer.on_message_received(
                can.Message(timestamp=stamp, arbitration_id=number, is_extended_id=extended, data=data, channel=0)
            )
    return path


WRITERS = {"log": candump, "asc": asc, "blf": blf}
# since 1970 a float64 steps by 2^-22 s, half of which is its rounding; BLF counts from its first frame, in ns
RESOLUTION = {"log": 2**-23, "asc": 0.0, "blf": 2**-22}
START = {"log": 1_700_000_000, "asc": 0, "blf": 1_700_000_000}


@pytest.fixture
def base(tmp_path: Path) -> Path:
    path = tmp_path / "drive.dbc"
    path.write_text(DBC)
    return path


@pytest.mark.parametrize("form", WRITERS)
def test_values_and_stamps_come_back(tmp_path: Path, base: Path, form: str) -> None:
    recording = open_here(WRITERS[form](tmp_path / f"drive.{form}"))
    assert recording.names == NAMES
    assert recording.remarks == ()
    assert dict(recording.units) == {
        "Chassis.Speed": "km/h", "Chassis.Accel": "m/s2", "Pedals.Throttle": "%", "Pedals.Brake": "%",
        "Adas.Command": "m/s2",
    }  # fmt: skip
    channels = recording.read(NAMES)
    rounding = 2 * 2**-52  # of a product and a sum, relative to values of at most 1 in what is added
    assert np.abs(channels["Chassis.Speed"].values - 2 * NUMBERS / 100).max() <= 6 * rounding
    assert np.abs(channels["Chassis.Accel"].values - ((500 - NUMBERS) / 500 - 1)).max() <= rounding
    assert np.abs(channels["Adas.Command"].values - (NUMBERS - 150) / 1000).max() <= rounding
    assert channels["Adas.Mode"].values.tolist() == (NUMBERS % 2).tolist()
    for every, name in enumerate(("Chassis.Speed", "Pedals.Page", "Adas.Mode")):
        late = channels[name].time - START[form] - stamps(every) / 1e6
        assert np.abs(late).max() <= RESOLUTION[form]


@pytest.mark.parametrize("form", WRITERS)
def test_a_signal_has_samples_where_its_multiplexer_shows_it(tmp_path: Path, base: Path, form: str) -> None:
    channels = open_here(WRITERS[form](tmp_path / f"drive.{form}")).read(["Pedals.Throttle", "Pedals.Brake"])
    even, odd = NUMBERS[::2], NUMBERS[1::2]
    assert channels["Pedals.Throttle"].values.tolist() == (even % 200 / 2).tolist()
    assert channels["Pedals.Brake"].values.tolist() == (odd % 200 / 2).tolist()


def test_only_messages_that_are_asked_for_are_decoded(
    tmp_path: Path, base: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from cantools.database.can import Message

    decoded: list[str] = []
    decode = Message.decode
    monkeypatch.setattr(Message, "decode", lambda self, *a, **o: (decoded.append(self.name), decode(self, *a, **o))[1])
    recording = open_here(candump(tmp_path / "drive.log"))
    assert decoded == []
    assert list(recording.read(["Adas.Mode"])) == ["Adas.Mode"]
    assert decoded == ["Adas"] * COUNT


def test_which_database_is_taken(tmp_path: Path) -> None:
    log = candump(tmp_path / "drive.log")
    refused(log, "is a CAN log, which a DBC database decodes; found none beside it; needs drive.dbc beside")
    (tmp_path / "car.DBC").write_text(DBC)
    assert open_here(log).names == NAMES
    (tmp_path / "other.dbc").write_text(DBC)
    refused(log, "its folder holds 2: car.DBC, other.dbc")
    (tmp_path / "drive.dbc").write_text(DBC.replace("Chassis", "Body"))
    assert open_here(log).names[0] == "Body.Speed"


def test_messages_of_one_name_are_told_apart(tmp_path: Path, base: Path) -> None:
    base.write_text(DBC.replace("Pedals: 4", "Chassis: 4"))
    names = open_here(candump(tmp_path / "drive.log")).names
    assert {"Chassis.Speed", "Chassis.200.Throttle"} <= set(names)


def test_a_database_of_another_car_or_none_at_all(tmp_path: Path, base: Path) -> None:
    log = candump(tmp_path / "drive.log")
    base.write_text(
        DBC.replace("BO_ 256 ", "BO_ 257 ").replace("BO_ 512", "BO_ 513").replace("2566844926", "2566844927")
    )
    refused(log, "holds no message of its database; identifiers in the log: 100, 200, 18FEF1FE; in the database: 101")
    base.write_text("not a database")
    with pytest.raises(InputError, match=r"drive\.dbc: is damaged .* a DBC database is needed"):
        open_here(log)
    base.write_text('VERSION ""\n')
    with pytest.raises(InputError, match="defines no message"):
        open_here(log)


def test_one_identifier_on_two_buses_is_read_from_the_first(tmp_path: Path, base: Path) -> None:
    path = candump(tmp_path / "drive.log", "can3")
    lines = path.read_text().splitlines(keepends=True)
    path.write_text("".join(lines[:9]) + lines[0].replace("can3", "can4") + "".join(lines[9:]))
    recording = open_here(path)
    assert recording.remarks == ("identifiers that several buses have are read from the bus of their first: 100",)
    assert len(recording.read(["Chassis.Speed"])["Chassis.Speed"].time) == COUNT


@pytest.mark.parametrize("form", ["log", "asc"])
def test_a_line_without_an_end_is_left_out(tmp_path: Path, base: Path, form: str) -> None:
    path = WRITERS[form](tmp_path / f"drive.{form}")
    lines = path.read_bytes().splitlines(keepends=True)[: 4 + 6]
    path.write_bytes(b"".join(lines)[:-3])
    recording = open_here(path)
    assert recording.remarks == ("the last line does not end; it is left out",)


def test_a_log_cut_off_within_a_container_is_read_up_to_it(tmp_path: Path, base: Path) -> None:
    path = blf(tmp_path / "drive.blf")
    raw = path.read_bytes()
    whole = len(open_here(path).read(["Adas.Mode"])["Adas.Mode"].time)
    path.write_bytes(raw[: len(raw) * 2 // 3])
    recording = open_here(path)
    assert any("the log is cut off after frame" in remark for remark in recording.remarks)
    assert 0 < len(recording.read(["Adas.Mode"])["Adas.Mode"].time) < whole


HEADER = b"LOGG" + struct.pack("<I", 144) + bytes(136)


@pytest.mark.slow
def test_an_object_that_would_hold_a_reader_for_ever(
    tmp_path: Path, base: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "drive.blf"
    endless = zlib.compress(struct.pack("<4sHHII", b"LOBJ", 32, 1, 0, 115) + bytes(32))
    head = struct.pack("<4sHHII", b"LOBJ", 16, 1, 32 + len(endless), 10) + struct.pack("<H6xI4x", 2, 48)
    path.write_bytes(HEADER + head + endless)
    monkeypatch.setattr(apart, "MOST_SECONDS", 10.0)
    with pytest.raises(InputError, match=r"drive\.blf: .* is needed"):
        open_recording(path)


@pytest.mark.parametrize("form", WRITERS)
def test_damage_is_read_or_refused(tmp_path: Path, base: Path, form: str, fresh_seed: int) -> None:
    path = WRITERS[form](tmp_path / f"drive.{form}")
    survives(path, path.read_bytes(), fresh_seed, cuts=10, flips=25)


def test_damage_to_a_database_is_read_or_refused(tmp_path: Path, base: Path, fresh_seed: int) -> None:
    import random

    from tests.damage import KINDS, damaged

    from .survival import outcome

    log, rng = candump(tmp_path / "drive.log"), random.Random(fresh_seed)
    log.write_text("".join(log.read_text().splitlines(keepends=True)[:30]))
    for i in range(25):
        base.write_bytes(damaged(DBC.encode(), i % KINDS, rng))
        said = outcome(log)
        assert not isinstance(said, str) or said.isprintable()
