"""Nothing outside the workbench's folder is read, and uploads and answers take free places inside it."""

from __future__ import annotations

from pathlib import Path

import pytest

from avtorch.app.workplace import Workplace, examples
from avtorch.errors import InputError
from avtorch.io import Log


@pytest.fixture
def place(tmp_path: Path) -> Workplace:
    (tmp_path / "work").mkdir()
    (tmp_path / "secret.csv").write_text("time,speed\n")
    (tmp_path / "work" / "drive.csv").write_text("time,speed\n")
    return Workplace.of(tmp_path / "work")


def test_a_log_inside_is_found(place: Workplace) -> None:
    assert place.name_of(place.inside("drive.csv")) == "drive.csv"
    assert place.logs() == ["drive.csv"]


@pytest.mark.parametrize("name", ["../secret.csv", "drive.csv/../../secret.csv", "..", ".", "", "/etc/passwd", "a\0b"])
def test_what_leads_out_is_refused(place: Workplace, name: str) -> None:
    with pytest.raises(InputError, match=r"outside|no such file"):
        place.inside(name)


def test_a_link_that_leads_out_is_refused(place: Workplace) -> None:
    (place.root / "link.csv").symlink_to(place.root.parent / "secret.csv")
    with pytest.raises(InputError, match="outside"):
        place.inside("link.csv")


@pytest.mark.parametrize("name", ["../../x.csv", "/etc/x.csv", "..\\x.csv", "...", "a\nb/x.csv", "x" * 300 + ".csv"])
def test_an_upload_stays_in_its_folder(place: Workplace, name: str) -> None:
    path = place.upload(name)
    assert path.parent == place.root / "out" / "logs"
    assert path.resolve().parent == path.parent
    path.write_text("taken")
    assert place.upload(name) != path


def test_answers_take_folders_of_their_own(place: Workplace) -> None:
    names = [place.name_of(place.answer("sub/drive one.csv")) for _ in range(2)]
    assert names == ["out/drive_one", "out/drive_one-2"]
    place.give_up(place.root / names[1])
    assert not (place.root / names[1]).exists()
    (place.root / names[0] / "report.html").write_text("kept")
    place.give_up(place.root / names[0])
    assert (place.root / names[0] / "report.html").exists()


def test_a_place_that_cannot_be_written_is_named(place: Workplace) -> None:
    (place.root / "out").write_text("a file")
    with pytest.raises(InputError, match="cannot be made"):
        place.answer("drive.csv")


def test_answers_and_hidden_files_are_no_logs(place: Workplace) -> None:
    for name in ("out/drive/manoeuvre.csv", "out/logs/mine.csv", ".git/x.csv", "notes.md"):
        (place.root / name).parent.mkdir(parents=True, exist_ok=True)
        (place.root / name).write_text("x")
    assert place.logs() == ["drive.csv", "out/logs/mine.csv"]


def test_examples_are_logs(place: Workplace, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.delenv("AVTORCH_DATA", raising=False)
    assert list(examples()) == ["simulated"]
    assert Log.read(place.root / place.example("simulated")).rows == 1800
    with pytest.raises(InputError, match="needs one of simulated"):
        place.example("../secret")
    monkeypatch.setenv("AVTORCH_DATA", str(tmp_path))
    (tmp_path / "genesis").mkdir()
    (tmp_path / "genesis" / "lap1.csv").write_text("time,accel_cmd,speed\n")
    assert (place.root / place.example("recorded")).read_text() == "time,accel_cmd,speed\n"


def test_no_folder(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="is no folder"):
        Workplace.of(tmp_path / "missing")
