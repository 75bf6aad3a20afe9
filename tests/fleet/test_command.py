"""`avtorch fleet`, as it is typed."""

from __future__ import annotations

import importlib.util
import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from avtorch.cli import main
from tests.fleet.drives import write_fleet

FAST = ["--only", "check,estimate", "--estimator", "map", "--dead-time", "0"]


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.slow
def test_cars_are_printed_in_their_order_with_what_failed(
    here: Path, scheduler: str, capsys: pytest.CaptureFixture[str]
) -> None:
    write_fleet(here / "logs", {"red": 0.3, "blue": 1.8})
    (here / "logs" / "green").mkdir()
    (here / "logs" / "green" / "drive.csv").write_text("a,b\n1,2\n")
    command = ["fleet", "logs", "--out", "out", "--scheduler", scheduler, *FAST]
    assert main(command) == 0
    told = capsys.readouterr()
    lines = told.out.splitlines()
    assert lines[0] == "3 logs of 3 cars, each named by the folder of its logs"
    assert lines[1].startswith("Dask's dashboard: http")
    assert "T_L [s]" in told.out
    # rows and head wrap where the terminal is narrow
    cars = [line.split()[0] for line in lines if line.startswith(("blue ", "green ", "red "))]
    assert cars == ["blue", "green", "red"]
    assert "below" in told.out
    assert "Failed: logs/green/drive.csv: column 'time' is missing" in told.out
    assert "6 answers computed, 0 kept from earlier runs." in told.out
    assert told.err == ""
    assert json.loads((here / "out" / "fleet.json").read_text())["schema"] == "avtorch.fleet/1"
    assert "Written to out: fleet.html, fleet.json" in told.out
    page = (here / "out" / "fleet.html").read_text(encoding="utf-8")
    assert "1 of 2 estimated cars is below the target" in page
    assert "avtorch fleet logs --out out" in page
    assert main([*command, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["work"] == {"kept": 6, "computed": 0}
    assert main([*command, "--quiet"]) == 0
    assert capsys.readouterr().out == ""


@pytest.mark.slow
def test_a_cluster_of_its_own_tells_where_its_dashboard_is(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_fleet(here / "logs", {"red": 0.3})
    assert main(["fleet", "logs", "--out", "out", "--workers", "1", *FAST]) == 0
    told = capsys.readouterr()
    assert re.search(r"^Dask's dashboard: http://127\.0\.0\.1:\d+/status$", told.out, re.M)
    assert told.err == ""


def test_the_extra_is_named_where_it_is_missing(
    here: Path, refused: Callable[[list[str]], str], monkeypatch: pytest.MonkeyPatch
) -> None:
    write_fleet(here / "logs", {"red": 0.3})
    find = importlib.util.find_spec

    def without(name: str, *more: Any) -> Any:
        return None if name == "distributed" else find(name, *more)

    monkeypatch.setattr(importlib.util, "find_spec", without)
    told = refused(["fleet", "logs", "--out", "out"])
    assert told == "avtorch: a fleet needs distributed, which is not installed: pip install 'avtorch[fleet]'\n"
    assert not (here / "out").exists()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--only", "check,drive"], "--only: found 'check,drive', needs some of check, estimate, diagnose"),
        (["--workers", "0"], "--workers: found 0, needs 1 or more"),
        (["--workers", "2", "--scheduler", "tcp://127.0.0.1:1"], "--workers: found beside --scheduler"),
        (["--memory", "much"], "memory: found 'much', needs a size such as 2GiB"),
        (["--effects", "dead_tim"], "--effects: found 'dead_tim', needs an effect's name; perhaps dead_time"),
        (["--baseline", "none.toml"], "--baseline 'none.toml': no such file"),
        (["--target", "2"], "target: found 2, needs a probability"),
        (["--gains", "1,2"], "--gains: found '1,2'"),
        (["--dead-time", "5"], "dead_time: found 5 s"),
    ],
)
def test_bad_options_are_one_line(
    options: list[str], message: str, here: Path, refused: Callable[[list[str]], str]
) -> None:
    write_fleet(here / "logs", {"red": 0.3})
    assert refused(["fleet", "logs", "--out", "out", *options]).startswith(f"avtorch: {message}")
    assert not (here / "out").exists()


def test_a_file_in_place_of_the_folder_is_refused(here: Path, refused: Callable[[list[str]], str]) -> None:
    write_fleet(here / "logs", {"red": 0.3})
    (here / "out").write_text("a file")
    assert "out: cannot be made" in refused(["fleet", "logs", "--out", "out"])
