"""The fleet's first answer: cars in the order in which to look at them, each with its rows.

A car below the target of P(string stable) comes first, then one with a log that failed, then one that differs from its
own past, then one that differs from its siblings, then the others by the gap of their simulator.

A car has a cause where more than half of its diagnosed drives name it. Of `have` cars among `diagnosed`, the share of
all such cars has the belief Beta(have + 1/2, diagnosed - have + 1/2), from Jeffreys' prior.
"""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from statistics import fmean, pvariance
from typing import Any

from avtorch.fleet.folder import DATASETS, FleetFolder, Row, drive_belief
from avtorch.fleet.log_list import FleetLog, LogList
from avtorch.fleet.settings import FleetSettings
from avtorch.version import __version__

SCHEMA = "avtorch.fleet/1"
APART = 0.05
"""Expected share of false ones among the cars that are said to differ from their siblings."""

CHANGED = 3.0
"""Standard deviations between drives from which a car is said to differ from its past."""

REASONS = ("below target", "failed", "changed", "unlike siblings", "gap", "sound", "no answer")
"""Why a car is where it is, in order."""


def fleet_answer(found: LogList, folder: FleetFolder, settings: FleetSettings) -> dict[str, Any]:
    """The object of `fleet.json`, from the rows in `folder`."""
    of_car: dict[str, list[FleetLog]] = {}
    for log in found.logs:
        of_car.setdefault(log.car, []).append(log)
    cars = [_car(car, sorted(logs, key=_when), folder, settings) for car, logs in of_car.items()]
    beliefs = {car["car"]: car.pop("beliefs") for car in cars}
    common, beside = None, {}
    if any(beliefs.values()):
        from avtorch.fleet.population import population  # needs torch

        common, beside = population(beliefs)
    diagnosed = {car["car"]: drives for car in cars if (drives := car.pop("diagnosed"))}
    has = {car: car_causes(drives) for car, drives in diagnosed.items()}
    causes = fleet_causes(has)
    sizes: dict[str, dict[str, Any]] = {}
    for cause in causes:
        from avtorch.fleet.population import effect_sizes

        name = cause["name"]
        told = {car: [one["sizes"] for one in diagnosed[car]] for car, (named, _) in has.items() if name in named}
        cause["parameters"], own = effect_sizes(name, told)
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
    for step in settings.steps:
        read = folder.rows(step, log)
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
    out["sizes"] = {}
    if row["causes"]:
        from avtorch.fleet.population import drive_sizes

        out["sizes"] = drive_sizes(row["causes"])
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


COMMON, SINGLE = 2 / 3, 1 / 3
"""The model's: the 90 % interval of the share of cars is above the first. Single cars': below the second."""

Diagnosed = Mapping[str, Any]
"""A drive's `named` causes, and those `alike`, which its log cannot tell from them."""


def car_causes(drives: Sequence[Diagnosed]) -> tuple[list[str], list[str]]:
    """The causes that a car has by most of its drives, and those that it may have instead of them."""
    return _mostly(drives, "named"), _mostly(drives, "alike")


def _mostly(drives: Sequence[Diagnosed], key: str) -> list[str]:
    names = {name for drive in drives for name in drive[key]}
    return sorted(name for name in names if 2 * sum(name in drive[key] for drive in drives) > len(drives))


def fleet_causes(cars: Mapping[str, tuple[Sequence[str], Sequence[str]]]) -> list[dict[str, Any]]:
    """The causes that some car has, the most common first: how many cars, the share's interval, and whose it is.

    `cars`: of each diagnosed car what `car_causes` returns. A cause is single cars' only if those that may have it in
    place of another are few as well.
    """
    count = len(cars)
    found = []
    for name in sorted({n for named, _ in cars.values() for n in named}):
        have = [car for car, (named, _) in cars.items() if name in named]
        may = sum(name in {*named, *alike} for named, alike in cars.values())
        share, most = _share(len(have), count), _share(may, count)
        verdict = "not decided"
        if share["q05"] > COMMON:
            verdict = "the model's"
        elif most["q95"] < SINGLE:
            verdict = "single cars'"
        one: dict[str, Any] = {"name": name, "cars": len(have), "may": may, "diagnosed": count, "share": share}
        found.append(one | {"verdict": verdict, "of": have if verdict == "single cars'" else None})
    return sorted(found, key=lambda one: (-one["cars"], one["name"]))


def _share(have: int, count: int) -> dict[str, float]:
    from scipy.special import betaincinv

    a, b = have + 0.5, count - have + 0.5
    return {"mean": a / (a + b), "q05": float(betaincinv(a, b, 0.05)), "q95": float(betaincinv(a, b, 0.95))}
