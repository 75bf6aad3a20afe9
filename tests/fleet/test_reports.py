"""Reports of diagnosed logs: where they lie, and that none outlives its answer."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from avtorch.fleet import FleetLog, FleetSettings, run_fleet
from avtorch.fleet.folder import FleetFolder
from tests.fleet.drives import drive

DONE: list[dict[str, Any]] = [{"verdict": ["none"]}]


def test_a_report_goes_with_its_answer(tmp_path: Path) -> None:
    folder, log = FleetFolder(tmp_path), FleetLog("a.csv", "../red car")
    folder.write("diagnose", log, "key", DONE, sha256="0", seconds=0.0, report="<p>page</p>")
    assert folder.report(log).read_text() == "<p>page</p>"
    # the manifest names another car since
    other = replace(log, car="blue")
    assert folder.kept("diagnose", other, "key") == "done"
    assert [row["car"] for row in folder.rows("diagnose", other)] == ["blue"]
    assert folder.report(other).read_text() == "<p>page</p>"
    folder.write("diagnose", other, "key", DONE, sha256="0", seconds=0.0)
    assert not folder.report(other).exists()


@pytest.mark.slow
def test_reports_are_written_by_the_worker_and_made_where_missing(tmp_path: Path, scheduler: str) -> None:
    for car, lag in {"red": 0.4, "blue": 0.3}.items():
        (tmp_path / "logs" / car).mkdir(parents=True)
        drive(lag, seconds=14.0).write(tmp_path / "logs" / car / "drive.csv")
    settings = FleetSettings(steps=("diagnose",), effects=("dead_time",), pairs=False, posterior="laplace")

    def fleet(**more: Any) -> dict[str, Any]:
        return run_fleet(tmp_path / "logs", tmp_path / "out", settings=settings, scheduler=scheduler, **more)

    plain = fleet()
    assert plain["failed_logs"] == 0
    assert [log["report"] for car in plain["cars"] for log in car["logs"]] == [None, None]
    full = fleet(report=str)
    assert full["work"]["computed"] == 2
    for car in full["cars"]:
        (log,) = car["logs"]
        assert log["report"].startswith("reports/drive-")
        assert (tmp_path / "out" / log["report"]).read_text().startswith(car["gap"]["summary"])
    assert fleet(report=str)["work"]["computed"] == 0
    assert fleet()["cars"] == full["cars"]
