"""Recorded leaders of every form, on small made-up files and on the recordings."""

from __future__ import annotations

import csv
import re
from pathlib import Path

import numpy as np
import pytest

from avtorch.errors import InputError
from avtorch.io import Log, check, read_following, read_leader
from avtorch.io.us06 import US06_SPEED_MPS

ZALA = """Date,8,10,2019
Vehicle_order,TARGET,RED,BLUE,GREEN,
Number_of_vehicles,4
ACC,1
Distance_setting,S
Time,Speed2,E2,N2,Alt2,Speed4,E4,N4,Alt4,IVS2,IVS3
100.1,8.0,1,2,3,7.0,,,,,-1.0
100.2,8.1,1,2,3,7.1,,,,5.0,20.5
100.3,8.2,1,2,3,,,,,5.0,20.4
100.4,8.3,1,2,3,7.3,,,,5.0,20.3
100.5,8.4,1,2,3,7.4,,,,5.0,
100.6,8.5,1,2,3,7.5,,,,5.0,20.2
"""


@pytest.fixture
def zala(tmp_path):
    (tmp_path / "part.csv").write_text(ZALA)
    return tmp_path / "part.csv"


def test_zalazone_numbers_skip_and_cells_are_empty(zala):
    first = read_leader(zala)
    assert first.name == "part, vehicle 2"
    np.testing.assert_array_equal(first.speed, [8.0, 8.1, 8.2, 8.3, 8.4, 8.5])
    assert first.note == ""
    fourth = read_leader(zala, vehicle=4)
    assert fourth.name == "part, vehicle 4"
    np.testing.assert_array_equal(fourth.time, [100.4, 100.5, 100.6])
    assert "rows 4 to 6 of 6" in fourth.note
    with pytest.raises(InputError, match=r"vehicle 3 is not in it; vehicles: 2, 4"):
        read_leader(zala, vehicle=3)


def test_zalazone_errors_name_the_line_of_the_file(zala):
    zala.write_text(ZALA.replace("100.3", "100.1"))
    with pytest.raises(InputError, match=r"row 3 \(line 9\), column 'Time': goes back"):
        read_leader(zala)
    zala.write_text(ZALA.replace(",8.3,", ",slow,"))
    with pytest.raises(InputError, match=r"row 4 \(line 10\), column 'Speed2': 'slow'"):
        read_leader(zala)
    zala.write_text(ZALA.replace(",7.4,,,,5.0,\n", ",7.4,,,,5.0\n"))
    with pytest.raises(InputError, match=r"row 5 \(line 11\): has 10 cells where the header has 11"):
        read_leader(zala)


def test_plain_form(tmp_path):
    path = tmp_path / "lead.csv"
    path.write_text("time,speed,why\n0,10,a\n1,20,b\n2,-0.5,c\n10,3,d\n")
    leader = read_leader(path)
    np.testing.assert_allclose(leader.speed, [10, 20, 0])
    assert "rows 1 to 3 of 4" in leader.note
    assert "set to zero" in leader.note


@pytest.mark.parametrize(
    ("text", "options", "what"),
    [
        ("time,velocity\n0,1\n1,2\n", {}, "is no leader file"),
        ("time,speed\n0,1\n", {}, "at least two"),
        ("time,speed\n0,1\n0,2\n", {}, "row 2 (line 3), column 'time': repeats"),
        ("time,speed\n0,1\n1,200\n", {}, "row 2 (line 3), column 'speed': is 200"),
        ("time,speed\n0,1\n1,\n2,3\n", {}, "row 2 (line 3), column 'speed': is empty"),
        ("time,speed\n0,1\n9,1\n", {}, "no two rows in a row"),
        ("time,speed\n0,1\n1,2\n", {"vehicle": 1}, "vehicle 1 has no meaning"),
        ("time,speed\n0,1\n1,2\n", {"event": 1}, "event 1 has no meaning"),
        ("event,time,lead_speed\n1,0,3\n1,0.1,3\n", {"event": 2}, "event 2 is not in it"),
        ("event,time,lead_speed\n1,0,3\n1,0.1,3\n", {"vehicle": 2}, "vehicle 2 has no meaning"),
        ("event,time,lead_speed\n1,0,3\n1.5,0.1,3\n", {}, "row 2 (line 3), column 'event': is 1.5"),
        ("event,time,lead_speed\n1,0,3\n2,0,3\n1,0.1,3\n", {"event": 1}, "row 3 (line 4), column 'event'"),
        ("event,time,lead_speed\n1,0,3\n2,0,3\n2,0.1,x\n", {"event": 2}, "row 3 (line 4), column 'lead_speed'"),
        ("Time,SpeedDoppler1\n0,1\n0.1,1\n", {"vehicle": 2}, "vehicles: 1"),
        ("Time,Velocity\n0,1\n0.1,999\n", {}, "column 'Velocity': is 277.5"),
    ],
)
def test_a_bad_leader_file(tmp_path, text, options, what):
    path = tmp_path / "lead.csv"
    path.write_text(text)
    with pytest.raises(InputError, match=re.escape(what)) as fault:
        read_leader(path, **options)
    assert str(fault.value).startswith(str(path))


def test_us06_is_the_published_schedule(data_dir):
    with open(data_dir / "drive_cycles" / "us06.csv", encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    assert [float(row["time"]) for row in rows] == list(range(601))
    # the recording gives five significant digits: half a unit of the last one, at most 0.0005 m/s
    np.testing.assert_allclose(US06_SPEED_MPS, [float(row["speed"]) for row in rows], rtol=0, atol=5.01e-4)


def test_us06_in_the_figures_everyone_quotes():
    assert len(US06_SPEED_MPS) == 601
    assert max(US06_SPEED_MPS) / 0.44704 == pytest.approx(80.3)
    assert sum(US06_SPEED_MPS) / 1609.344 == pytest.approx(8.01, abs=0.005)  # miles


@pytest.mark.slow
def test_every_recording_is_read(data_dir):
    forms = {
        "openacc_astazero": "vehicle 1",
        "openacc_zalazone": "vehicle",
        "ngsim": "NGSIM",
        "i24": "2021",
        "genesis": "lap",
    }
    count = 0
    for path in sorted(data_dir.glob("*/*.csv")):
        if path.name == "Slope.csv":
            continue
        leader = read_leader(path)
        assert forms.get(path.parent.name, path.stem) in leader.name
        assert len(leader.time) == len(leader.speed) > 100
        assert (np.diff(leader.time) > 0).all()
        assert ((leader.speed >= 0) & (leader.speed < 40)).all()
        count += 1
    assert count >= 20


def test_every_vehicle_of_the_platoons(data_dir):
    platoons = {
        "openacc_astazero/ASta_040719_platoon7": (1, 2, 3, 4, 5),
        "openacc_zalazone/handling_part1": tuple(range(2, 11)),
        "openacc_zalazone/handling_part38": (2, 3, 4, 5, 6, 8, 10),
    }
    for stem, vehicles in platoons.items():
        path = data_dir / f"{stem}.csv"
        for vehicle in vehicles:
            assert np.isfinite(read_leader(path, vehicle=vehicle).speed).all()
        for vehicle in (0, 11):
            with pytest.raises(InputError, match="is not in it"):
                read_leader(path, vehicle=vehicle)


def test_spacing_belongs_to_the_vehicle_behind(data_dir):
    """Its derivative is the speed of the one ahead less the own: a wrong neighbour shows no correlation."""
    for path in ("openacc_astazero/ASta_040719_platoon7.csv", "openacc_zalazone/handling_part1.csv"):
        log = read_following(data_dir / path, vehicle=3)
        closing = np.gradient(log.spacing, log.time)
        assert np.corrcoef(closing, log.lead_speed - log.speed)[0, 1] > 0.8


def test_i24_is_converted(data_dir):
    leader = read_leader(data_dir / "i24" / "2021-03-12-22-20-57_0.csv")
    assert leader.speed[0] == pytest.approx(58.7268 / 3.6)


def test_the_genesis_laps_as_logs(data_dir):
    for path in sorted(data_dir.glob("genesis/*.csv")):
        log = Log.read(path)
        seen = check(log)
        assert seen.rate_hz == pytest.approx(100, rel=1e-3)
        assert seen.gaps == ()
        assert seen.doubtful_units == ()
        assert seen.missing == ("accel",)
        assert any("comes at 50 Hz and is held" in note for note in seen.notes)


@pytest.mark.slow
def test_the_platoons_as_following_logs(data_dir):
    for stem in ("platoon7", "platoon8"):
        (path,) = data_dir.glob(f"openacc_astazero/*{stem}.csv")
        for i in range(2, 6):
            names = {"time": "Time", "speed": f"SpeedDoppler{i}", "accel": f"Accel{i}"}
            names |= {"spacing": f"Spacing{i}", "lead_speed": f"SpeedDoppler{i - 1}"}
            seen = check(Log.read(path, map=names, following=True))
            assert seen.doubtful_units == ()
            assert seen.standstill_rows > 0


def test_a_platoon_without_a_vehicle_is_refused(tmp_path: Path) -> None:
    """Found by the fuzzer: a column that is called as those of vehicles are, and bears no number."""
    path = tmp_path / "platoon.csv"
    path.write_text("Time,SpeedDoppler\n0.0,1.0\n", encoding="utf-8")
    with pytest.raises(InputError, match=r"platoon.csv: is no leader file"):
        read_leader(path)


@pytest.mark.parametrize("event", [None, 1])
def test_a_recording_of_no_rows_is_refused(tmp_path: Path, event: int | None) -> None:
    """Found by the fuzzer."""
    path = tmp_path / "events.csv"
    path.write_text("event,time,spacing,speed,lead_speed\n", encoding="utf-8")
    with pytest.raises(InputError, match=r"events.csv: found a header but no rows"):
        read_leader(path, event=event)
