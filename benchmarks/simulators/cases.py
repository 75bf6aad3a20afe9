"""Sealed cases: the log of a car, and a simulator that is the same car, or lacks one thing of it.

The simulator is the blind test's reference vehicle, simulated millisecond by millisecond, with an actuator of second
order, a map that depends on speed, drag and a delay of its own, all drawn. The car is the same (a quarter of the
cases), the same with one of these parameters changed (three tenths), or the same with an effect besides (the rest), of
medium visibility: what lag and gain cannot follow is 1.25 to 2.83 times the noise. Causes that cannot be that visible
on a drive are drawn anew.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from avtorch import ExternalSimulator, Log, diagnose
from avtorch.arrays import FloatArray
from avtorch.external import FmuSimulator
from avtorch.gap.result.diagnosis import Diagnosis
from avtorch.io import STANDSTILL_MPS
from benchmarks.blindtest import EFFECTS, Car, draw_car, draw_drive, draw_recorder, simulate
from benchmarks.blindtest.several import excess_range, solve_strength
from benchmarks.simulators.fmu import write_fmu
from benchmarks.simulators.vehicle import Effects, SteppedVehicle, whole_drive

SECONDS, RATE_HZ = 100.0, 50
CHANGED = {
    "dead_time": "delay_s",
    "second_order_actuator": "natural_frequency_radps",
    "speed_dependent_gain": "gain_slope",
    "aerodynamic_drag": "drag_per_m",
    "K_L": "",
}
"""Parameters that may be wrong, by what they belong to."""


def draw(seed: int, number: int) -> dict[str, Any]:
    """A case: the car's log, the vehicle that is the simulator, and the truth."""
    rng = np.random.default_rng((seed, number))
    while True:
        case = _drawn(rng, number)
        if case is not None:
            return case


def _drawn(rng: np.random.Generator, number: int) -> dict[str, Any] | None:
    """None where no size of the cause is of medium visibility."""
    place = number % 20
    kind = "none" if place < 5 else "parameter" if place < 11 else "effect"
    car, plan = draw_car(rng), draw_drive(rng, seconds=SECONDS)
    plan = replace(plan, rate_hz=RATE_HZ)
    # a gain whose slope is wrong is right at the drive's mean speed: elsewhere it would be the gain that is wrong
    pilot = simulate(car, plan.pilot(), seconds=SECONDS, rate_hz=RATE_HZ, seed=number)
    speed = float(pilot.speed[pilot.speed > STANDSTILL_MPS].mean())
    own = {
        "second_order_actuator": {
            "natural_frequency_radps": rng.uniform(4.0, 9.0),
            "damping_ratio": rng.uniform(0.6, 1.1),
        },
        # a smaller slope would be as good as none: missing, where the car has one
        "speed_dependent_gain": {
            "gain_slope": rng.choice([-1.0, 1.0]) * rng.uniform(0.1, 0.25),
            "reference_speed_mps": speed,
        },
        "aerodynamic_drag": {
            "drag_per_m": rng.uniform(2e-4, 6e-4),
            "wind_mps": 0.0,
            "wind_swing_mps": 0.0,
            "wind_period_s": 60.0,
        },
        "dead_time": {"delay_s": rng.uniform(0.05, 0.25)},
    }
    others = [name for name, f in EFFECTS.items() if not f.by_chance and name not in own and _suits(f, plan)]
    cause = "none"
    at: Callable[[float], Mapping[str, float]] = lambda s: {}  # noqa: E731
    sign, strongest = (1.0 if rng.random() < 0.5 else -1.0), 4.0
    if kind == "effect":
        cause = str(rng.choice(others))
        at, strongest = EFFECTS[cause].draw(rng, car, plan), EFFECTS[cause].strongest
    elif kind == "parameter":
        cause = str(rng.choice(list(CHANGED)))

    def change(s: float) -> tuple[Car, Effects]:
        factor = (1.0 + 0.25 * s) ** sign
        if kind == "none":
            return car, own
        if kind == "effect":
            return car, {**own, cause: at(s)}
        if cause == "K_L":
            return replace(car, K_L=car.K_L * factor), own
        key = CHANGED[cause]
        value = own[cause][key]
        # a slope may change its sign; sizes do not
        other = value + 0.2 * s * sign if key == "gain_slope" else value * factor
        return car, {**own, cause: {**own[cause], key: other}}

    def driven(other: Car, effects: Effects) -> Any:
        return simulate(other, plan.pilot(), seconds=SECONDS, rate_hz=RATE_HZ, effects=effects, seed=number)

    def trial(s: float) -> tuple[float, float]:
        other, effects = change(s)
        run = driven(other, effects)
        start = float(run.speed[0])
        plain, plain_speed = whole_drive(car, own, run.command, RATE_HZ, speed=start)
        with_it, other_speed = whole_drive(other, effects, run.command, RATE_HZ, speed=start)
        moving = np.minimum(plain_speed, other_speed) > STANDSTILL_MPS
        columns = [] if kind == "parameter" else [plain[moving], np.gradient(plain)[moving]]
        return _excess((with_it - plain)[moving], columns, float(run.noise_accel.std())), s

    strength = 0.0
    if kind != "none":
        low, high = excess_range("medium")
        found = solve_strength(trial, float(np.sqrt(low * high)), low, high, begin=1.0, strongest=strongest)
        if found is None:
            return None
        strength = found
    run = driven(*change(strength))
    log = Log.from_arrays(
        name="car", time=run.time, accel_cmd=run.command, accel=run.accel, speed=np.maximum(run.speed, 0.0)
    )
    return {"number": number, "kind": kind, "cause": cause, "log": log, "vehicle": SteppedVehicle(car, own)}


def _suits(family: Any, plan: Any) -> bool:
    return not family.suits or plan.manoeuvre in family.suits


def _excess(difference: FloatArray, columns: list[FloatArray], noise: float) -> float:
    """Size of what `columns` cannot follow, over the noise."""
    x = difference
    if columns:
        basis = np.stack(columns, -1)
        x = x - basis @ np.linalg.lstsq(basis, x, rcond=None)[0]
    return float(np.sqrt(np.mean(x**2))) / noise


def behind_a_recorder(case: Mapping[str, Any], seed: int) -> dict[str, Any]:
    drawn = draw_recorder(np.random.default_rng((seed, case["number"], 1)), RATE_HZ)
    recorder = replace(drawn, dropped=0.0, overrides_per_min=0.0)
    return {**case, "log": recorder.record(case["log"], case["number"])}


# What a diagnosis says of a case, by each way to bring a simulator, and whether that is right.
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
