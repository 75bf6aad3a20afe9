"""Which logs a fleet has, and of which car each is."""

from __future__ import annotations

import gzip
import os
from pathlib import Path

import pytest

from avtorch.errors import InputError
from avtorch.fleet import find_logs, run_fleet
from avtorch.fleet.log_list import content_hash, fetched
from avtorch.io import answer_set, write_json
from tests.fleet.drives import QUICK, drive, write_fleet


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def touch(*names: str) -> None:
    for name in names:
        Path(name).parent.mkdir(parents=True, exist_ok=True)
        Path(name).write_text("time,accel_cmd,speed\n")


def found(*sources: str) -> tuple[dict[str, str], str]:
    logs = find_logs(sources)
    return {log.place: log.car for log in logs.logs}, logs.car_from


def test_files_and_globs_of_one_folder_are_cars_by_their_names(here: Path) -> None:
    touch("logs/a.csv", "logs/b.csv.gz", "logs/c.tsv")
    assert found("logs/*.csv") == ({"logs/a.csv": "a"}, "file")
    expected = {"logs/a.csv": "a", "logs/b.csv.gz": "b"}
    # named twice, it is one log
    assert found("logs/a.csv", "./logs/a.csv", "logs/b*") == (expected, "file")
    touch("logs/a.tsv")
    assert found("logs/a.*") == ({"logs/a.csv": "a.csv", "logs/a.tsv": "a.tsv"}, "file")


def test_several_folders_are_cars(here: Path) -> None:
    touch("logs/red/1.csv", "logs/red/2.csv", "logs/blue/1.csv")
    expected = {"logs/blue/1.csv": "blue", "logs/red/1.csv": "red", "logs/red/2.csv": "red"}
    assert found("logs") == found("logs/**/*.csv") == (expected, "folder")
    touch("more/red/1.csv")
    assert found("logs/red", "more")[0] == {
        "logs/red/1.csv": "logs/red",
        "logs/red/2.csv": "logs/red",
        "more/red/1.csv": "more/red",
    }


def test_folders_that_end_alike_are_told_apart_by_as_many_names_as_it_takes(here: Path) -> None:
    touch("d/red/run_1/data/log.csv", "d/blue/run_1/data/log.csv", "d/blue/run_2/data/log.csv", "d/green/log.csv")
    assert list(found("d")[0].values()) == ["blue/run_1/data", "blue/run_2/data", "green", "red/run_1/data"]


def test_a_name_that_is_no_text_is_a_log(here: Path, scheduler: str) -> None:
    write_fleet(here, {"red": 0.4})
    os.rename(b"red/drive.csv", b"red/m_\xe4.csv")
    answer = run_fleet(".", "out", settings=QUICK, scheduler=scheduler)
    assert [(car["car"], car["reason"]) for car in answer["cars"]] == [("m_\\udce4", "sound")]
    write_json("again.json", answer)


def test_what_cannot_be_opened_is_a_row(here: Path, scheduler: str) -> None:
    write_fleet(here, {"red": 0.4})
    Path("fleet.csv").write_text(f"log,car\nred/drive.csv,red\n{300 * 'x'}.csv,blue\na\0.csv,green\n")
    cars = {car["car"]: car for car in run_fleet("fleet.csv", "out", settings=QUICK, scheduler=scheduler)["cars"]}
    assert {name: car["reason"] for name, car in cars.items()} == {"red": "sound", "blue": "failed", "green": "failed"}
    assert "cannot be read (File name too long)" in cars["blue"]["logs"][0]["errors"]["check"]
    assert "null" in cars["green"]["logs"][0]["errors"]["check"]


def test_a_folder_is_searched_for_what_can_be_read(here: Path) -> None:
    touch("logs/a.csv", "logs/README.md", "logs/a.toml", "logs/.hidden.csv", "logs/.git/x.csv", "logs/deep/er/b.TXT")
    Path("logs/drive.mcap").write_bytes(b"\x89MCAP0\r\n")
    Path("logs/bag").mkdir()
    Path("logs/bag/metadata.yaml").write_text("rosbag2_bagfile_information:\n")
    Path("logs/bag/part_0.db3").write_bytes(b"SQLite format 3\x00")
    places = {log.place for log in find_logs("logs").logs}
    assert places == {"logs/a.csv", "logs/drive.mcap", "logs/deep/er/b.TXT", "logs/bag"}


def test_what_avtorch_wrote_in_a_folder_is_no_log(here: Path, scheduler: str) -> None:
    write_fleet(here, {"red": 0.4})
    run_fleet(".", "red/out", settings=QUICK, scheduler=scheduler)
    with answer_set("red", ["diagnosis.json", "manoeuvre.csv"]) as staged:
        write_json(staged / "diagnosis.json", {})
        (staged / "manoeuvre.csv").touch()
    assert [log.place for log in find_logs(".").logs] == ["red/drive.csv"]
    drive().write("red/drive.parquet")
    assert len(find_logs(".").logs) == 2
    # the same by a glob, which finds the fleet's own folder and other answers too
    globbed = find_logs("**/*.parquet", leave_out="red/out").logs
    assert (
        [log.place for log in globbed] == [log.place for log in find_logs("**/*.parquet").logs] == ["red/drive.parquet"]
    )
    Path("red/fleet.csv").write_text("log,car\ndrive.csv,red\n")
    assert len(find_logs(".").logs) == 2, "a manifest is no log"


@pytest.mark.parametrize(
    ("sources", "message"),
    [
        (["missing.csv"], "missing.csv: no such file"),
        (["empty"], "empty: no log there"),
        (["*.mf4"], "*.mf4: no log there"),
        ([], "logs: found none"),
        (["fleet.csv", "a.csv"], "fleet.csv: is a manifest; needs to be the only source"),
        (["nowhere://x/a.csv"], "nowhere://x/a.csv: cannot be reached"),
        (["memory://none/a.csv"], "memory://none/a.csv: no log there"),
    ],
)
def test_sources_without_logs_are_one_line(sources: list[str], message: str, here: Path) -> None:
    touch("a.csv")
    Path("empty").mkdir()
    Path("fleet.csv").write_text("log,car\na.csv,red\n")
    with pytest.raises(InputError, match=message.replace("*", r"\*")):
        find_logs(sources)


def test_a_manifest_names_cars_dates_and_tags(here: Path) -> None:
    Path("fleets").mkdir()
    text = '﻿log, car ,date,route\nlogs/a.csv,red,2026-11-23,A9\n\n"/data/b, c.csv",blue,,\ns3://x/c.csv,blue,2026-11-23T08:30,\n'
    Path("fleets/all.csv").write_text(text, encoding="utf-8")
    logs = find_logs("fleets/all.csv")
    assert logs.car_from == "manifest"
    assert [(log.place, log.car, log.date, dict(log.tags)) for log in logs.logs] == [
        ("fleets/logs/a.csv", "red", "2026-11-23", {"route": "A9"}),
        ("/data/b, c.csv", "blue", None, {}),
        ("s3://x/c.csv", "blue", "2026-11-23T08:30", {}),
    ]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("log,date\na.csv,\n", "line 1: has no column car; needs a header such as log,car,date"),
        ("log,car,car\na.csv,red,red\n", "line 1: found log, car, car, needs a name of its own for each column"),
        ("log,car\n", "has no row below its header"),
        ("log,car\na.csv\n", r"row 1 \(line 2\): has 1 cells, needs 2"),
        ("log,car\na.csv,red\n,blue\n", r"row 2 \(line 3\), column log: is empty"),
        ("log,car\na.csv,red\nb.csv,\n", r"row 2 \(line 3\), column car: is empty"),
        ("log,car\na.csv,red\n./a.csv,red\n", r"row 2 \(line 3\), column log: 'a.csv' is already in row 1"),
        (
            "log,car,date\na.csv,red,23.11.2026\n",
            r"row 1 \(line 2\), column date: found '23.11.2026', needs a date",
        ),
        ('log,car\n"a.csv,red\n', "is no CSV"),
        (b"log,car\na.csv,r\xfft\n", "line 2: is not UTF-8"),
    ],
)
def test_an_error_in_a_manifest_names_file_row_and_column(text: str | bytes, message: str, here: Path) -> None:
    Path("fleet.csv").write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(InputError, match=f"^fleet.csv: .*{message}"):
        find_logs("fleet.csv")


@pytest.mark.parametrize(
    "text",
    [
        '"log","car"\n"a.csv","red"\n',
        "log;car\na.csv;red\n",
        "log,car,time\na.csv,red,noon\n",
        "log,car\r\na.csv,red\r\n",
    ],
)
def test_a_manifest_as_other_programs_write_it(text: str, here: Path) -> None:
    Path("fleet.csv").write_bytes(text.encode())
    (log,) = find_logs("fleet.csv").logs
    assert (log.place, log.car) == ("a.csv", "red")


def test_a_log_with_a_column_called_log_is_no_manifest(here: Path) -> None:
    Path("a.csv").write_text("time,accel_cmd,speed,log\n0,0,1,1\n")
    assert found("a.csv") == ({"a.csv": "a"}, "file")


def test_the_hash_of_a_log_is_that_of_all_that_it_is_read_with(here: Path) -> None:
    def digest() -> str:
        return content_hash(Path("a.csv"))[0]

    touch("a.csv")
    seen = [digest()]
    Path("a.toml").write_text('[unit]\nspeed = "km/h"\n')
    seen.append(digest())
    assert len(set(seen)) == 2
    Path("b.csv").write_text("not its own")
    assert digest() == seen[-1]
    os.mkfifo("pipe")
    with pytest.raises(InputError, match=r"^pipe: is no regular file"):
        content_hash(Path("pipe"))


def test_a_copy_from_a_store_has_its_name_and_its_mapping(here: Path) -> None:
    Path("a.csv.gz").write_bytes(gzip.compress(b"time\n"))
    Path("a.toml").write_text("")
    with fetched(f"file://{here}/a.csv.gz") as local:
        assert local.name == "a.csv.gz"
        assert local.parent != here
        assert {p.name for p in local.parent.iterdir()} == {"a.csv.gz", "a.toml"}
    assert not local.parent.exists()
    with pytest.raises(InputError, match=r"b\.csv: no such file"), fetched(f"file://{here}/b.csv"):
        pass
