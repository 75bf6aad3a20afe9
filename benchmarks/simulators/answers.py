"""What a diagnosis says of a case, by each way to bring a simulator, and whether that is right."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from avtorch import ExternalSimulator, Log, diagnose
from avtorch.external import FmuSimulator
from avtorch.gap.result.diagnosis import Diagnosis
from benchmarks.simulators.cases import RATE_HZ
from benchmarks.simulators.fmu import write_fmu
from benchmarks.simulators.vehicle import SteppedVehicle, whole_drive

WAYS = ("output", "object", "fmu")


def answered(case: Mapping[str, Any], by: str) -> dict[str, Any]:
    log, vehicle = case["log"], case["vehicle"]
    begun, wall = time.process_time(), time.monotonic()
    with tempfile.TemporaryDirectory() as folder:
        if by == "output":
            baseline = ExternalSimulator(_output(vehicle, log))
        elif by == "object":
            baseline = ExternalSimulator(vehicle)
        else:
            file = write_fmu(vehicle, Path(folder, "vehicle.fmu"), 1 / RATE_HZ)
            baseline = ExternalSimulator(FmuSimulator(file))
        found = diagnose(log, baseline=baseline, posterior="laplace")
    row = {key: case[key] for key in ("number", "kind", "cause")} | {"by": by}
    spent = {"seconds": time.process_time() - begun, "wall": time.monotonic() - wall}
    return row | judged(case, found) | spent


def _output(vehicle: SteppedVehicle, log: Log) -> Log:
    assert log.accel_cmd is not None
    assert log.speed is not None
    accel, speed = whole_drive(vehicle.car, vehicle.effects, log.accel_cmd[:-1], RATE_HZ, speed=float(log.speed[0]))
    return Log.from_arrays(
        name="simulator", time=log.time[1:], accel_cmd=log.accel_cmd[1:], accel=accel, speed=np.maximum(speed, 0.0)
    )


def judged(case: Mapping[str, Any], found: Diagnosis) -> dict[str, Any]:
    """Whether the verdict is right, and whether it is of the right kind.

    Right is what the answer says of the simulator: what it lacks, or which parameter is wrong. `nothing_else`: neither
    is anything else named, such as a gust, which is the car's and by chance, or another parameter.
    """
    facts = found.tested
    assert facts is not None
    wrong = {p.name.partition(".")[0] for p in facts.wrong}
    named = set(facts.missing)
    kind = "effect" if named else "parameter" if wrong else "unknown" if found.verdict.abstained else "none"
    alike = {part for alias in found.verdict.alias_set for part in alias.split("+")}
    cause = case["cause"]
    right = {
        "none": kind == "none",
        "effect": named == {cause},
        "parameter": kind == "parameter" and cause in wrong,
    }[case["kind"]]
    besides = {"none": set(), "effect": {cause}, "parameter": {cause} - {"K_L"}}[case["kind"]]
    alone = set(found.verdict.names) - {"none"} == besides and wrong <= (
        {cause} if case["kind"] == "parameter" else set()
    )
    return {
        "answer": list(found.verdict.names),
        "missing": sorted(named),
        "wrong": sorted(wrong),
        "answered_kind": kind,
        "right": right,
        "nothing_else": right and alone,
        "right_kind": kind == case["kind"],
        "in_alias_set": right or (case["kind"] == "effect" and cause in alike),
        "left": max(facts.left.values()),
    }
