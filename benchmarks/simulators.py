"""What does a simulator lack that is not made of effects? Sealed cases of the reference vehicle.

``python -m benchmarks.simulators --n 100 --seed 1 [--by output|simulator] [--recorder ordinary] [--out
FILE]``

The simulator, by its output or driven along, is the blind test's reference vehicle, simulated millisecond by
millisecond, with an actuator of second order, a map that depends on speed, drag and a delay of its own, all drawn. The
car is the same (a quarter of the cases), the same with one of these parameters changed (three tenths), or the same with
an effect besides (the rest), of medium visibility: what lag and gain cannot follow is 1.25 to 2.83 times the noise.
Causes that cannot be that visible on a drive are drawn anew. Behind an ordinary recorder the car's readings are
filtered, held, rounded and shaken, with clocks of their own; it loses no rows and nobody takes over, so that both have
the same commands. With --out, cases already there are kept.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from avtorch import ExternalSimulator, Log, diagnose
from avtorch.arrays import FloatArray
from avtorch.blindtest import EFFECTS, Car, Recorded, draw_car, draw_drive, draw_recorder, simulate
from avtorch.blindtest.intervals import wilson
from avtorch.blindtest.strength import excess_range, solve_strength
from avtorch.gap.result.diagnosis import Diagnosis
from avtorch.io import STANDSTILL_MPS

SECONDS, RATE_HZ = 100.0, 50
Effects = Mapping[str, Mapping[str, float]]
CHANGED = {
    "dead_time": "delay_s",
    "second_order_actuator": "natural_frequency_radps",
    "speed_dependent_gain": "gain_slope",
    "aerodynamic_drag": "drag_per_m",
    "K_L": "",
}
"""Parameters that may be wrong, by what they belong to."""


class Vehicle:
    """The reference vehicle without noise, as a simulator that takes drives as a whole."""

    def __init__(self, car: Car, effects: Effects) -> None:
        self._car, self._effects = car.silent(), effects

    def reset(self, *, speed: float, accel: float) -> None:
        raise NotImplementedError("takes whole drives")

    def step(self, accel_cmd: float, dt: float) -> tuple[float, float]:
        raise NotImplementedError("takes whole drives")

    def whole_drive(
        self, accel_cmd: FloatArray, dt: FloatArray, *, speed: float, accel: float
    ) -> tuple[FloatArray, ...]:
        command = np.append(accel_cmd, accel_cmd[-1])
        pilot = Recorded(command, start_speed=speed)
        run = simulate(self._car, pilot, seconds=len(command) / RATE_HZ, rate_hz=RATE_HZ, effects=self._effects)
        return run.accel[1:], run.speed[1:]


def draw(seed: int, number: int) -> dict[str, Any]:
    """A case: the car's log, the simulator, and the truth."""
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
        plain, plain_speed = Vehicle(car, own).whole_drive(run.command, np.zeros(0), speed=start, accel=0.0)
        with_it, other_speed = Vehicle(other, effects).whole_drive(run.command, np.zeros(0), speed=start, accel=0.0)
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
    other, effects = change(strength)
    run = driven(other, effects)
    log = Log.from_arrays(
        name="car", time=run.time, accel_cmd=run.command, accel=run.accel, speed=np.maximum(run.speed, 0.0)
    )
    return {"number": number, "kind": kind, "cause": cause, "log": log, "simulator": Vehicle(car, own)}


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


def answered(case: Mapping[str, Any], by: str) -> dict[str, Any]:
    log, simulator = case["log"], case["simulator"]
    begun = time.process_time()
    if by == "output":
        speed = float(log.speed[0])
        accel, speeds = simulator.whole_drive(log.accel_cmd[:-1], np.zeros(0), speed=speed, accel=0.0)
        output = Log.from_arrays(
            name="simulator",
            time=log.time[1:],
            accel_cmd=log.accel_cmd[1:],
            accel=accel,
            speed=np.maximum(speeds, 0.0),
        )
        found = diagnose(log, baseline=ExternalSimulator(output), posterior="laplace")
    else:
        found = diagnose(log, baseline=ExternalSimulator(simulator), posterior="laplace")
    row = {key: case[key] for key in ("number", "kind", "cause")}
    return row | judged(case, found) | {"seconds": time.process_time() - begun}


def judged(case: Mapping[str, Any], found: Diagnosis) -> dict[str, Any]:
    """Whether the verdict is right, and whether it is of the right kind."""
    facts = found.tested
    assert facts is not None
    wrong = {p.name.partition(".")[0] for p in facts.wrong}
    named = set(facts.missing)
    kind = "effect" if named else "parameter" if wrong else "unknown" if found.verdict.abstained else "none"
    alike = {part for alias in found.verdict.alias_set for part in alias.split("+")}
    cause = case["cause"]
    right = {
        "none": kind == "none",
        "effect": found.verdict.names == (cause,) and kind == "effect",
        "parameter": kind == "parameter" and cause in wrong,
    }[case["kind"]]
    return {
        "answer": list(found.verdict.names),
        "wrong": sorted(wrong),
        "answered_kind": kind,
        "right": right,
        "right_kind": kind == case["kind"],
        "in_alias_set": right or (case["kind"] == "effect" and cause in alike),
        "left": max(facts.left.values()),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--n", type=int, default=20)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--by", choices=["output", "simulator"], default="output")
    parser.add_argument("--recorder", choices=["ideal", "ordinary"], default="ideal")
    parser.add_argument("--out", type=Path)
    given = parser.parse_args()
    out: Path | None = given.out
    rows = [json.loads(x) for x in out.read_text().splitlines()] if out and out.exists() else []
    for number in sorted(set(range(given.n)) - {row["number"] for row in rows}):
        case = draw(given.seed, number)
        row = answered(behind_a_recorder(case, given.seed) if given.recorder == "ordinary" else case, given.by)
        rows.append(row)
        print(json.dumps(row), flush=True)
        if out:
            with out.open("a") as stream:
                stream.write(json.dumps(row) + "\n")
    for kind in ("none", "parameter", "effect"):
        own = [row for row in rows if row["kind"] == kind]
        for key in ("right", "in_alias_set", "right_kind"):
            hits = sum(row[key] for row in own)
            if own:
                low, high = wilson(hits, len(own)) or (0.0, 1.0)
                print(f"{kind}: {key} {hits} of {len(own)} ({low:.2f} to {high:.2f})")
    print(f"median {np.median([row['seconds'] for row in rows]):.1f} processor s")


if __name__ == "__main__":
    main()
