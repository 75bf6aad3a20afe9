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

from avtorch.fleet.folder import DATASETS, INTERVAL, QUANTITIES, STATS, Drive, FleetFolder, Row, drive_belief
from avtorch.fleet.log_list import FleetLog, LogList
from avtorch.fleet.settings import FleetSettings, Step
from avtorch.version import __version__

SCHEMA = "avtorch.fleet/1"
APART = 0.05
"""Expected share of false ones among the cars that are said to differ from their siblings."""

CHANGED = 3.0
"""Standard deviations between drives from which a car is said to differ from its past."""

COMMON, SINGLE = 2 / 3, 1 / 3
"""The model's: the 90 % interval of the share of cars is above the first. Single cars': below the second."""

REASONS = ("below target", "failed", "changed", "unlike siblings", "gap", "sound", "no answer")
"""Why a car is where it is, in order."""

Diagnosed = Mapping[str, Any]
"""A drive's `named` causes, those `alike`, which its log cannot tell from them, and the `sizes` of the named."""


def fleet_answer(found: LogList, folder: FleetFolder, settings: FleetSettings) -> dict[str, Any]:
    """The object of `fleet.json`, from the rows in `folder`."""
    of_car: dict[str, list[FleetLog]] = {}
    for log in found.logs:
        of_car.setdefault(log.car, []).append(log)
    cars: list[dict[str, Any]] = []
    beliefs: dict[str, list[Drive]] = {}
    diagnosed: dict[str, list[Diagnosed]] = {}
    for name, logs in of_car.items():
        car, beliefs[name], diagnosed[name] = _car(name, sorted(logs, key=_when), folder, settings)
        cars.append(car)
    has = {car: car_causes(drives) for car, drives in diagnosed.items() if drives}
    causes = fleet_causes(has)
    common, beside = None, {}
    if causes or any(beliefs.values()):
        from avtorch.fleet.population import effect_sizes, population  # needs torch

        common, beside = population(beliefs)
        for cause in causes:
            name = cause["name"]
            told = {car: [one["sizes"] for one in diagnosed[car]] for car, (named, _) in has.items() if name in named}
            cause["parameters"], own = effect_sizes(name, told)
            for car in cars:
                if car["car"] in own:
                    car["effects"][name] = own[car["car"]]
    place = {}
    for car in cars:
        car["siblings"] = beside.get(car["car"])
        car["reason"], place[car["car"]] = _reason(car, settings.target)
    cars.sort(key=lambda car: _rank(car, place[car["car"]]))
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


def _car(
    name: str, logs: Sequence[FleetLog], folder: FleetFolder, settings: FleetSettings
) -> tuple[dict[str, Any], list[Drive], list[Diagnosed]]:
    """What the rows say of a car, and of its drives for all cars together; `logs` in order of time."""
    drives, past, gaps, diagnosed = [], [], [], []
    for log in logs:
        drive, rows = _log(log, folder, settings)
        drives.append(drive)
        if used := [row for row in rows.get("estimate", ()) if row["used"]]:
            past.append(_actuation(used))
        for row in rows.get("diagnose", ()):
            gaps.append(_gap(row))
            diagnosed.append(_diagnosed(row))
    latest = past[-1] if past else None
    car: dict[str, Any] = {"car": name, "reason": "no answer", "p_string_stable": None, "T_L": None, "K_L": None}
    car |= {"change": None, "siblings": None, "effects": {}, "gap": gaps[-1] if gaps else None, "logs": drives}
    if latest is not None:
        lowest = min(one["lowest"] for one in past)
        car["p_string_stable"] = {"now": latest["p_string_stable"], "lowest": lowest}
        car |= {quantity: latest[quantity]["belief"] for quantity in QUANTITIES}
        if len(past) > 1:
            car["change"] = {quantity: _change([one[quantity] for one in past]) for quantity in QUANTITIES}
    return car, [one["log"] for one in past if one["log"] is not None], diagnosed


def _log(log: FleetLog, folder: FleetFolder, settings: FleetSettings) -> tuple[dict[str, Any], dict[Step, list[Row]]]:
    """A log's entry, and its rows of each step that was done."""
    places = {DATASETS[s]: folder.path(s, log).relative_to(folder.root).as_posix() for s in settings.steps}
    out: dict[str, Any] = {"log": log.shown, "date": log.date, "tags": dict(log.tags), "errors": {}, "rows": places}
    report = folder.report(log)
    there = "diagnose" in settings.steps and report.is_file()
    out["report"] = report.relative_to(folder.root).as_posix() if there else None
    rows: dict[Step, list[Row]] = {step: folder.rows(step, log) for step in settings.steps}
    for step, read in rows.items():
        if not read or read[0]["status"] != "done":
            out["errors"][step] = read[0]["error"] if read else "its rows are missing or damaged"
            rows[step] = []
    return out, rows


def _actuation(used: Sequence[Row]) -> dict[str, Any]:
    """T_L and K_L over the used windows of a log, and the last of them."""
    last = used[-1]
    out: dict[str, Any] = {"p_string_stable": last["p_string_stable"], "log": drive_belief(used)}
    out["lowest"] = min(row["p_string_stable"] for row in used)
    for name in QUANTITIES:
        means = [row[f"{name}_mean"] for row in used]
        # what a drive's mean may vary by: windows differ by noise and by what the model lacks, and are not independent
        variance = pvariance(means) + fmean(row[f"{name}_sd"] ** 2 for row in used)
        belief = {part: last[f"{name}_{part}"] for part in STATS}
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
        | {"share": None if c["share_mean"] is None else {p: c[f"share_{p}"] for p in INTERVAL}}
        for c in row["causes"] or ()
    ]
    unexplained = {part: row[f"unexplained_{part}"] for part in (*INTERVAL, "material")}
    out = {"detected": row["gap_detected"], "before": row["gap_before"], "left": row["gap_left"]}
    out |= {"verdict": row["verdict"], "causes": causes, "summary": row["summary"]}
    return out | {"unexplained": None if unexplained["mean"] is None else unexplained}


def _diagnosed(row: Row) -> Diagnosed:
    """What a diagnosis says for all cars together; `unknown` is a cause that has no name yet."""
    causes, sizes = row["causes"] or (), {}
    if causes:
        from avtorch.fleet.population import drive_sizes

        sizes = drive_sizes(causes)
    # a pair's name is those of two with a plus between
    aliases = [*(row["alias_set"] or ()), *(name for cause in causes for name in cause.get("alias_set") or ())]
    alike = sorted({name for alias in aliases for name in alias.split("+")} - {"none", "unknown"})
    named = sorted({*row["verdict"], *(cause["name"] for cause in causes)} - {"none"})
    return {"named": named, "alike": alike, "sizes": sizes}


def _reason(car: dict[str, Any], target: float) -> tuple[str, float]:
    """Why a car is where it is, and its place among cars of that reason, the first the lowest."""
    stable, change, siblings, gap = (car[key] for key in ("p_string_stable", "change", "siblings", "gap"))
    if stable is not None and stable["now"] < target:
        return "below target", stable["now"]
    if any(log["errors"] for log in car["logs"]):
        return "failed", 0.0
    changed = 0.0 if change is None else max(one["in_sd"] for one in change.values())
    if changed >= CHANGED:
        return "changed", -changed
    if siblings is not None and siblings["q_value"] <= APART:
        return "unlike siblings", min(siblings[name]["tail"] for name in QUANTITIES)
    if gap is not None and gap["verdict"] != ["none"]:
        return "gap", 0.0
    return "no answer" if stable is None and gap is None else "sound", 0.0


def _rank(car: dict[str, Any], place: float) -> tuple[Any, ...]:
    stable, gap = car["p_string_stable"], car["gap"]
    size = 0.0 if gap is None or gap["before"] is None else gap["before"]
    probability = 1.0 if stable is None else stable["now"]
    return REASONS.index(car["reason"]), place, -size, probability, car["car"]


def _when(log: FleetLog) -> tuple[bool, datetime, str]:
    """Dated logs by their date, after those without one; these by their names."""
    if log.date is None:
        return False, datetime.min.replace(tzinfo=UTC), os.path.basename(log.place)
    date = datetime.fromisoformat(log.date)
    return True, date if date.tzinfo is not None else date.replace(tzinfo=UTC), log.place


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
