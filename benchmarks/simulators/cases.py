"""Sealed cases: the log of a car, and a simulator that is the same car, or lacks one thing of it.

The simulator is the blind test's reference vehicle, simulated millisecond by millisecond, with an actuator of second
order, a map that depends on speed, drag and a delay of its own, all drawn. The car is the same (a quarter of the
cases), the same with one of these parameters changed (three tenths), or the same with an effect besides (the rest), of
medium visibility: what lag and gain cannot follow is 1.25 to 2.83 times the noise. Causes that cannot be that visible
on a drive are drawn anew.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from avtorch import Log
from avtorch.arrays import FloatArray
from avtorch.io import STANDSTILL_MPS
from benchmarks.blindtest import EFFECTS, Car, draw_car, draw_drive, draw_recorder, simulate
from benchmarks.blindtest.strength import excess_range, solve_strength
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
