"""The count of a fleet's rows finds one that is lost, one that is doubled, and one that differs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pyarrow as pa
import pytest

import benchmarks.fleet_killed as bench
from avtorch.fleet import FleetSettings

SETTINGS = FleetSettings(steps=("check",))


@pytest.fixture
def paths(tmp_path: Path) -> list[Path]:
    return bench.written(tmp_path, 2, 10.0, seed=1)


def rows_of(paths: list[Path]) -> list[dict[str, Any]]:
    """As a fleet keeps them."""
    own = {path: bench._alone(path, "check", SETTINGS)[0] for path in paths}
    return [{"log": str(path), "error": None, "status": "done"} | row for path, row in own.items()]


def found(monkeypatch: pytest.MonkeyPatch, paths: list[Path], rows: list[dict[str, Any]]) -> list[str]:
    monkeypatch.setattr(bench, "read_rows", lambda out, dataset: pa.Table.from_pylist(rows))
    return bench.faults(paths, paths[0].parent, SETTINGS, checked=len(paths), seed=1)


def test_whole_rows_have_no_fault(monkeypatch: pytest.MonkeyPatch, paths: list[Path]) -> None:
    assert found(monkeypatch, paths, rows_of(paths)) == []


@pytest.mark.slow
def test_a_lost_a_doubled_and_a_changed_row_are_told(monkeypatch: pytest.MonkeyPatch, paths: list[Path]) -> None:
    one, other = rows_of(paths)
    assert any("no rows of check" in line for line in found(monkeypatch, paths, [one]))
    assert any("2 rows of check" in line for line in found(monkeypatch, paths, [one, other, other]))
    changed = other | {"rows": other["rows"] + 1}
    assert found(monkeypatch, paths, [one, changed]) == [
        f"{paths[1].name}: rows of check differ from those computed by themselves"
    ]
    stranger = other | {"log": "car9.csv"}
    assert found(monkeypatch, paths, [one, other, stranger]) == ["car9.csv: rows of a log that is not there"]


@pytest.mark.parametrize(("windows", "right"), [([4, 3, 5], True), ([3, 5], False), ([3, 4, 4], False)])
def test_a_window_that_is_missing_or_doubled_is_told(
    windows: list[int], right: bool, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    rows = [{"log": "car0.csv", "error": None, "status": "done", "window": number} for number in windows]
    monkeypatch.setattr(bench, "read_rows", lambda out, dataset: pa.Table.from_pylist(rows))
    settings = FleetSettings(steps=("estimate",))
    assert (bench.faults([Path("car0.csv")], tmp_path, settings, checked=0, seed=1) == []) == right
