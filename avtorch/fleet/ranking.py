"""The fleet's first answer: cars in the order in which to look at them, each with its rows.

A car below the target of P(string stable) comes first, then one with a log that failed, then one that differs from its
own past, then one that differs from its siblings, then the others by the gap of their simulator.
"""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from datetime import UTC, datetime
from statistics import fmean, pvariance
from typing import Any

from avtorch.fleet.folder import DATASETS, FleetFolder, Row
from avtorch.fleet.log_list import FleetLog, LogList
from avtorch.fleet.population import (
    APART,
    car_causes,
    drive_belief,
    drive_sizes,
    effect_sizes,
    fleet_causes,
    population,
)
from avtorch.fleet.settings import FleetSettings, Step
from avtorch.version import __version__

SCHEMA = "avtorch.fleet/1"
CHANGED = 3.0
"""Standard deviations between drives from which a car is said to differ from its past."""

REASONS = ("below target", "failed", "changed", "unlike siblings", "gap", "sound", "no answer")
"""Why a car is where it is, in order."""

_CHECK = ["status", "error"]
_WINDOW = ["status", "error", "used", "end_s", "p_string_stable"]
_WINDOW += [f"{name}_{part}" for name in ("T_L", "K_L") for part in ("mean", "sd", "q05", "q95")]
_DIAGNOSIS = ["status", "error", "verdict", "causes", "gap_before", "gap_left", "gap_detected", "summary"]
_DIAGNOSIS += ["alias_set"]
_DIAGNOSIS += [f"unexplained_{part}" for part in ("mean", "q05", "q95", "material")]


def fleet_answer(found: LogList, folder: FleetFolder, settings: FleetSettings) -> dict[str, Any]:
    """The object of `fleet.json`, from the rows in `folder`."""
    of_car: dict[str, list[FleetLog]] = {}
    for log in found.logs:
        of_car.setdefault(log.car, []).append(log)
    cars = [_car(car, sorted(logs, key=_when), folder, settings) for car, logs in of_car.items()]
    common, beside = population({car["car"]: car.pop("beliefs") for car in cars}, settings.seed)
    diagnosed = {car["car"]: drives for car in cars if (drives := car.pop("diagnosed"))}
    has = {car: car_causes(drives) for car, drives in diagnosed.items()}
    causes = fleet_causes(has)
    sizes: dict[str, dict[str, Any]] = {}
    for cause in causes:
        name = cause["name"]
        told = {car: [one["sizes"] for one in diagnosed[car]] for car, (named, _) in has.items() if name in named}
        cause["parameters"], own = effect_sizes(name, told, settings.seed)
        for car, values in own.items():
            sizes.setdefault(car, {})[name] = values
    for car in cars:
        car["siblings"] = beside.get(car["car"])
        car["effects"] = sizes.get(car["car"], {})
        car["reason"] = _reason(car, settings.target)
    cars.sort(key=_rank)
    elsewhere = folder.others(list(found.logs))
    notes = [f"The folder has rows of {elsewhere} more logs, which this call did not name."] if elsewhere else []
    failed = sum(bool(log["errors"]) for car in cars for log in car["logs"])
    answer = {
        "schema": SCHEMA,
        "version": __version__,
        "car_from": found.car_from,
        "steps": list(settings.steps),
        "target": settings.target,
        "logs": len(found.logs),
        "failed_logs": failed,
        "reasons": {reason: sum(car["reason"] == reason for car in cars) for reason in REASONS},
        "population": common,
        "causes": causes,
        "cars": [{"rank": number, **car} for number, car in enumerate(cars, 1)],
        "notes": notes,
    }
    return _plain(answer)


def _plain(x: Any) -> Any:
    """The same with null in place of numbers that JSON does not have."""
    if isinstance(x, dict):
        return {key: _plain(value) for key, value in x.items()}
    if isinstance(x, list):
        return [_plain(value) for value in x]
    return None if isinstance(x, float) and not math.isfinite(x) else x


def _car(car: str, logs: Sequence[FleetLog], folder: FleetFolder, settings: FleetSettings) -> dict[str, Any]:
    """What the rows say of a car; `logs` in order of time."""
    drives = [_log(log, folder, settings) for log in logs]
    past = [d for d in (one.pop("actuation") for one in drives) if d is not None]
    diagnosed = [d for d in (one.pop("diagnosis") for one in drives) if d is not None]
    latest = past[-1] if past else None
    found: dict[str, Any] = {"car": car, "reason": "no answer", "p_string_stable": None, "T_L": None, "K_L": None}
    found |= {"change": None, "siblings": None, "effects": {}, "gap": None, "logs": drives}
    found["beliefs"] = [one["log"] for one in past if one["log"] is not None]
    found["diagnosed"] = [
        {"named": _named(one), "alike": one.pop("alike"), "sizes": one.pop("sizes")} for one in diagnosed
    ]
    if latest is not None:
        lowest = min(one["lowest"] for one in past)
        found["p_string_stable"] = {"now": latest["p_string_stable"], "lowest": lowest}
        found |= {name: latest[name]["belief"] for name in ("T_L", "K_L")}
        if len(past) > 1:
            found["change"] = {name: _change([one[name] for one in past]) for name in ("T_L", "K_L")}
    if diagnosed:
        found["gap"] = diagnosed[-1]
    return found


def _log(log: FleetLog, folder: FleetFolder, settings: FleetSettings) -> dict[str, Any]:
    rows = {DATASETS[s]: folder.path(s, log).relative_to(folder.root).as_posix() for s in settings.steps}
    out: dict[str, Any] = {"log": log.shown, "date": log.date, "tags": dict(log.tags), "errors": {}}
    report = folder.report(log)
    there = "diagnose" in settings.steps and report.is_file()
    out |= {"rows": rows, "report": report.relative_to(folder.root).as_posix() if there else None}
    out |= {"actuation": None, "diagnosis": None}
    wanted: dict[Step, list[str]] = {"check": _CHECK, "estimate": _WINDOW, "diagnose": _DIAGNOSIS}
    for step in settings.steps:
        read = folder.rows(step, log, wanted[step])
        if not read or read[0]["status"] != "done":
            out["errors"][step] = read[0]["error"] if read else "its rows are missing or damaged"
        elif step == "estimate":
            out["actuation"] = _actuation(read)
        elif step == "diagnose":
            out["diagnosis"] = _gap(read[0])
    return out


def _actuation(rows: Sequence[Row]) -> dict[str, Any] | None:
    """T_L and K_L over the used windows of a log, and the last of them; None where there is none."""
    used = [row for row in rows if row["used"]]
    if not used:
        return None
    last = used[-1]
    out: dict[str, Any] = {"p_string_stable": last["p_string_stable"], "log": drive_belief(used)}
    out["lowest"] = min(row["p_string_stable"] for row in used)
    for name in ("T_L", "K_L"):
        means = [row[f"{name}_mean"] for row in used]
        # what a drive's mean may vary by: windows differ by noise and by what the model lacks, and are not independent
        variance = pvariance(means) + fmean(row[f"{name}_sd"] ** 2 for row in used)
        belief = {part: last[f"{name}_{part}"] for part in ("mean", "sd", "q05", "q95")}
        out[name] = {"mean": fmean(means), "variance": variance, "belief": belief}
    return out


def _change(drives: Sequence[dict[str, Any]]) -> dict[str, float]:
    """The latest drive beside those before it; `in_sd`: by the standard deviation within drives and between them."""
    *before, now = drives
    past = fmean(one["mean"] for one in before)
    variance = fmean(one["variance"] for one in before) + pvariance([one["mean"] for one in before]) + now["variance"]
    difference = now["mean"] - past
    in_sd = abs(difference) / math.sqrt(variance) if variance > 0 else 0.0
    return {"past": past, "now": now["mean"], "difference": difference, "in_sd": in_sd}


def _gap(row: Row) -> dict[str, Any]:
    causes = [
        {"name": c["name"], "probability": c["probability"]}
        | {"share": None if c["share_mean"] is None else {p: c[f"share_{p}"] for p in ("mean", "q05", "q95")}}
        for c in row["causes"] or ()
    ]
    # a pair's name is those of two with a plus between
    aliases = [*(row["alias_set"] or ()), *(name for c in row["causes"] or () for name in c.get("alias_set") or ())]
    alike = sorted({name for alias in aliases for name in alias.split("+")} - {"none", "unknown"})
    unexplained = {part: row[f"unexplained_{part}"] for part in ("mean", "q05", "q95", "material")}
    out = {"detected": row["gap_detected"], "before": row["gap_before"], "left": row["gap_left"]}
    out |= {"verdict": row["verdict"], "causes": causes, "summary": row["summary"], "alike": alike}
    out["sizes"] = drive_sizes(row["causes"] or ())
    return out | {"unexplained": None if unexplained["mean"] is None else unexplained}


def _named(gap: dict[str, Any]) -> list[str]:
    """The causes of a diagnosis; `unknown` is one that has no name yet."""
    return sorted({*gap["verdict"], *(cause["name"] for cause in gap["causes"])} - {"none"})


def _reason(car: dict[str, Any], target: float) -> str:
    stable, change, gap = car["p_string_stable"], car["change"], car["gap"]
    if stable is not None and stable["now"] < target:
        return "below target"
    if any(log["errors"] for log in car["logs"]):
        return "failed"
    if change is not None and max(one["in_sd"] for one in change.values()) >= CHANGED:
        return "changed"
    if car["siblings"] is not None and car["siblings"]["q_value"] <= APART:
        return "unlike siblings"
    if gap is not None and gap["verdict"] != ["none"]:
        return "gap"
    return "sound" if stable is not None or gap is not None else "no answer"


def _rank(car: dict[str, Any]) -> tuple[Any, ...]:
    stable, change, gap = car["p_string_stable"], car["change"], car["gap"]
    probability = 1.0 if stable is None else stable["now"]
    changed = 0.0 if change is None else max(one["in_sd"] for one in change.values())
    size = 0.0 if gap is None or gap["before"] is None else gap["before"]
    apart = 1.0 if car["siblings"] is None else min(car["siblings"][name]["tail"] for name in ("T_L", "K_L"))
    order = {"below target": probability, "changed": -changed, "unlike siblings": apart}.get(car["reason"], 0.0)
    return REASONS.index(car["reason"]), order, -size, probability, car["car"]


def _when(log: FleetLog) -> tuple[bool, datetime, str]:
    """Dated logs by their date, after those without one; these by their names."""
    if log.date is None:
        return False, datetime.min.replace(tzinfo=UTC), os.path.basename(log.place)
    date = datetime.fromisoformat(log.date)
    return True, date if date.tzinfo is not None else date.replace(tzinfo=UTC), log.place
