"""The order of the cars, from rows written by hand."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from avtorch.fleet import FleetLog, FleetSettings, LogList
from avtorch.fleet.folder import FleetFolder
from avtorch.fleet.ranking import CHANGED, fleet_answer

SETTINGS = FleetSettings(steps=("estimate", "diagnose"))


def window(T_L: float, p: float, *, sd: float = 0.02, used: bool = True) -> dict[str, Any]:
    row: dict[str, Any] = {"used": used, "excited": used, "p_string_stable": p}
    for name, mean in (("T_L", T_L), ("K_L", 1.0)):
        row |= {f"{name}_mean": mean, f"{name}_sd": sd, f"{name}_q05": mean - sd, f"{name}_q95": mean + sd}
    return row


def diagnosis(verdict: str, before: float) -> dict[str, Any]:
    return {"verdict": [verdict], "gap_before": before, "gap_left": 1.0, "gap_detected": verdict != "none"}


class Fleet:
    """Rows of logs in a folder, each car's in the order in which it is given them."""

    def __init__(self, root: Path) -> None:
        self.folder, self.logs = FleetFolder(root), []

    def drive(self, car: str, windows: Any, diagnosed: Any = None, *, date: str | None = None) -> FleetLog:
        log = FleetLog(f"{car}-{len(self.logs)}.csv", car, date)
        self.logs.append(log)
        for step, rows in (("estimate", windows), ("diagnose", [diagnosed or diagnosis("none", 1.0)])):
            self.folder.write(step, log, "key", rows, sha256="0", seconds=0.0)  # type: ignore[arg-type]
        return log

    def answer(self) -> dict[str, Any]:
        return fleet_answer(LogList(tuple(self.logs), "file"), self.folder, SETTINGS)

    def cars(self) -> list[dict[str, Any]]:
        return self.answer()["cars"]


@pytest.fixture
def fleet(tmp_path: Path) -> Fleet:
    return Fleet(tmp_path)


@pytest.mark.slow
def test_cars_in_the_order_in_which_to_look_at_them(fleet: Fleet) -> None:
    fleet.drive("sound", [window(0.3, 1.0)])
    fleet.drive("small gap", [window(0.3, 1.0)], diagnosis("dead_time", 1.5))
    fleet.drive("large gap", [window(0.3, 1.0)], diagnosis("unknown", 3.0))
    fleet.drive("changed", [window(0.3, 1.0)])
    fleet.drive("changed", [window(0.5, 1.0)])
    fleet.drive("changed more", [window(0.3, 1.0)])
    fleet.drive("changed more", [window(0.6, 1.0)])
    fleet.drive("unread", [{"status": "failed", "error": "no speed"}])
    fleet.drive("unstable", [window(0.3, 1.0), window(1.5, 0.1)])
    fleet.drive("nearly", [window(0.3, 0.2), window(0.9, 0.85)])
    fleet.drive("idle", [window(0.3, 1.0, used=False)], {"status": "failed", "error": "too short"})
    order = [(car["car"], car["reason"]) for car in fleet.cars()]
    assert order == [
        ("unstable", "below target"),
        ("nearly", "below target"),
        ("unread", "failed"),
        ("idle", "failed"),
        ("changed more", "changed"),
        ("changed", "changed"),
        ("large gap", "gap"),
        ("small gap", "gap"),
        ("sound", "sound"),
    ]
    assert [car["rank"] for car in fleet.cars()] == list(range(1, 10))
    assert fleet.cars()[1]["p_string_stable"] == {"now": 0.85, "lowest": 0.2}


def test_the_latest_drive_is_by_date_whatever_the_order(fleet: Fleet) -> None:
    fleet.drive("red", [window(1.5, 0.1)], date="2026-11-23T09:00+02:00")
    fleet.drive("red", [window(0.3, 1.0)], date="2026-11-23T08:00")  # an hour later, in UTC
    fleet.drive("red", [window(0.3, 1.0)], date="2026-11-22")
    (car,) = fleet.cars()
    assert [log["date"] for log in car["logs"]] == ["2026-11-22", "2026-11-23T09:00+02:00", "2026-11-23T08:00"]
    assert (car["reason"], car["T_L"]["mean"]) == ("sound", 0.3)


def test_a_car_that_varies_from_drive_to_drive_has_not_changed(fleet: Fleet) -> None:
    for lag in (0.2, 0.6, 0.3, 0.5, 0.6):
        fleet.drive("lively", [window(lag, 1.0)])
    for lag in (0.30, 0.31, 0.30, 0.31, 0.6):
        fleet.drive("steady", [window(lag, 1.0)])
    steady, lively = fleet.cars()
    assert (steady["car"], steady["reason"], lively["reason"]) == ("steady", "changed", "sound")
    assert lively["change"]["T_L"]["in_sd"] < CHANGED < steady["change"]["T_L"]["in_sd"]
    change = steady["change"]["T_L"]
    assert (change["past"], change["now"]) == pytest.approx((0.305, 0.6))
    # two drives of 0.02 each, and 0.005 between those before
    assert change["in_sd"] == pytest.approx(0.295 / (2 * 0.02**2 + 0.005**2) ** 0.5)


def test_rows_that_went_missing_are_said(fleet: Fleet) -> None:
    log = fleet.drive("red", [window(0.3, 1.0)])
    fleet.folder.path("estimate", log).unlink()
    (car,) = fleet.cars()
    assert (car["reason"], car["logs"][0]["errors"]) == ("failed", {"estimate": "its rows are missing or damaged"})


@pytest.mark.slow
def test_a_car_unlike_its_siblings_comes_after_those_that_changed(fleet: Fleet) -> None:
    # drives of many cars tell how far those of one differ, the changed one's among them
    for _ in range(2):
        for number in range(12):
            fleet.drive(f"car {number}", [window(0.30 + 0.003 * number, 1.0)] * 3)
        fleet.drive("odd", [window(0.6, 1.0)] * 3)
    fleet.drive("changed", [window(0.3, 1.0)])
    fleet.drive("changed", [window(0.42, 1.0)])
    cars = fleet.cars()
    assert [(car["car"], car["reason"]) for car in cars[:2]] == [("changed", "changed"), ("odd", "unlike siblings")]
    assert {car["reason"] for car in cars[2:]} == {"sound"}
    assert cars[1]["siblings"]["T_L"]["tail"] < 1e-3 < cars[2]["siblings"]["T_L"]["tail"]


def test_what_a_verdict_cannot_tell_from_its_cause_is_one_that_the_car_may_have(fleet: Fleet) -> None:
    """Causes of chance are no parts of the gap: what they are alike stands in the verdict alone."""
    alike = {"alias_set": ["outliers", "gust", "dead_time+gust"]}
    for number in range(9):
        fleet.drive(f"car {number}", [window(0.3, 1.0)], diagnosis("outliers", 1.2) | alike)
    fleet.drive("other", [window(0.3, 1.0)], diagnosis("gust", 1.2) | {"alias_set": ["gust"]})
    causes = {cause["name"]: cause for cause in fleet.answer()["causes"]}
    assert (causes["gust"]["cars"], causes["gust"]["may"], causes["gust"]["verdict"]) == (1, 10, "not decided")


@pytest.mark.slow
def test_causes_are_those_of_the_cars_diagnoses(fleet: Fleet) -> None:
    late: dict[str, Any] = {"name": "dead_time", "alias_set": ["dead_time", "slow"], "probability": 0.9}
    for number in range(6):
        delay = {"name": "delay_s", "value_mean": 0.2 + 0.01 * number, "value_sd": 0.01}
        causes = {"causes": [late | {"parameters": [delay]}]}
        fleet.drive(f"car {number}", [window(0.3, 1.0)], diagnosis("dead_time", 2.0) | causes)
    fleet.drive("other", [window(0.3, 1.0)])
    answer = fleet.answer()
    (cause,) = answer["causes"]
    assert (cause["name"], cause["cars"], cause["diagnosed"]) == ("dead_time", 6, 7)
    assert "alike" not in answer["cars"][0]["gap"]
    delay = cause["parameters"]["delay_s"]
    assert (delay["cars"], delay["drives"], delay["unit"]) == (6, 6, "s")
    assert delay["typical"]["q05"] < 0.225 < delay["typical"]["q95"]
    of_cars = {car["car"]: car["effects"] for car in answer["cars"]}
    assert of_cars["other"] == {}
    assert 0.2 < of_cars["car 0"]["dead_time"]["delay_s"]["median"] < of_cars["car 5"]["dead_time"]["delay_s"]["median"]
