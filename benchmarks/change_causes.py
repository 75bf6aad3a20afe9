"""Does `avtorch.compare` name the cause of a change? On recordings, with known changes, and on the reference vehicle.

``AVTORCH_DATA=DIR python -m benchmarks.change_causes [--in-front SIZE ...] [--only TEXT]``
``python -m benchmarks.change_causes --simulated N [--seed 1] [--seconds 120] [--recorder ordinary]``

The first form prints a line for each pair of recordings: what is named, and the least change that would show. With
``--in-front`` a known effect of that size, or a gain, is put in front of the second recording of pairs that one car
drove. The second form compares drives of the reference vehicle, which lacks something on both sides, with one change
between them or none.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from avtorch import Log, compare, diagnose
from avtorch.errors import InputError
from avtorch.gap.result.comparison import ChangeCause, Comparison
from benchmarks.blindtest import MANOEUVRES, Car, DrivePlan, Recorder, draw_car, draw_recorder, put_in_front, simulate
from benchmarks.blindtest.intervals import counted
from benchmarks.recordings import folder

TRAINING = "roboracer/ftg_stanley_total_training.csv"
VALIDATION = "roboracer/ftg_stanley_total_validation.csv"
PAIRS: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "1:10 car, normal against one mass": ((TRAINING,), ("roboracer/Normal_1weight.csv",)),
    "1:10 car, normal against another mass": ((TRAINING,), ("roboracer/single_mass.csv",)),
    "1:10 car, normal against other tyres": ((TRAINING,), ("roboracer/tire_set_1.csv",)),
    "1:10 car, one mass against other tyres": (("roboracer/Normal_1weight.csv",), ("roboracer/tire_set_1.csv",)),
    "1:10 car, normal twice": ((TRAINING,), (VALIDATION,)),
    "genesis, lap 1 against 2": (("genesis/lap1.csv",), ("genesis/lap2.csv",)),
    "genesis, lap 2 against 3": (("genesis/lap2.csv",), ("genesis/lap3.csv",)),
    "genesis, lap 1 against 3": (("genesis/lap1.csv",), ("genesis/lap3.csv",)),
}
"""Recordings before and after, by name."""
ONE_CAR = {
    "genesis, laps 1 and 2 against 3": (("genesis/lap1.csv", "genesis/lap2.csv"), ("genesis/lap3.csv",)),
    "1:10 car, normal twice": ((TRAINING,), (VALIDATION,)),
}
"""Those of one car unchanged, long enough to put a change in front of."""
IN_FRONT = (
    "dead_time",
    "dead_band",
    "backlash",
    "brake_throttle_asymmetry",
    "speed_dependent_gain",
    "constant_resistance",
    "sensor_bias",
    "sensor_scale",
    "sensor_lag",
)
"""Effects that a car may gain between two drives; drag is left out, as a resistance in these narrow ranges of speed."""
GAIN = "K_L"
EFFECTS: dict[str, dict[str, float]] = {
    "dead_time": {"delay_s": 0.15},
    "constant_resistance": {"resistance_mps2": 0.2},
    "sensor_bias": {"bias_mps2": 0.1},
    "sensor_scale": {"scale": 1.15},
}
CARS = {"T_L": 1.4, GAIN: 0.8}
"""Changes of the reference vehicle: effects that appear, and factors."""
LACKS: Sequence[dict[str, dict[str, float]]] = (
    {},
    {"dead_band": {"half_width_mps2": 0.1}},
    {"brake_throttle_asymmetry": {"brake_gain_ratio": 0.8, "brake_lag_ratio": 1.0}},
    {"speed_dependent_gain": {"gain_slope": -0.3, "reference_speed_mps": 12.0}},
)
"""What the reference vehicle lacks before and after alike."""


def cell(cause: ChangeCause | None) -> str:
    """What is named, with its parameters, in one cell of a table."""
    if cause is None:
        return "too short"
    if not cause.parts:
        return {"unknown": "no known effect"}.get(cause.answer, cause.answer)
    cells = []
    for part in cause.parts:
        values = [f"{key} {q.mean:.3g} ({q.q05:.3g} to {q.q95:.3g})" for key, q in part.parameters.items()]
        alike = [name for name in part.alias_set if name != part.name]
        more = f" or {', '.join(alike)}" if alike else ""
        cells.append(f"{part.name}{more} {part.probability:.2f}: {', '.join(values)}")
    return "; ".join(cells)


def line(name: str, comparison: Comparison) -> str:
    cause = comparison.cause
    least = "" if cause is None else ", ".join(f"{key} {value:.2g}" for key, value in cause.detectable.items())
    lag, gain = (
        f"{ratio.mean:.2f} ({ratio.q05:.2f} to {ratio.q95:.2f})"
        for ratio in (comparison.car[key].ratio for key in ("T_L", "K_L"))
    )
    return f"| {name} | {lag} | {gain} | {cell(cause)} | {least} |"


def recordings(only: str) -> None:
    for name, pair in PAIRS.items():
        if only in name:
            try:
                comparison = compare(*([Log.read(folder() / file) for file in side] for side in pair))
            except InputError as refusal:
                print(f"| {name} | refused: {refusal} |", flush=True)
                continue
            print(line(name, comparison), flush=True)
            print(f"    {comparison.why}", flush=True)


def in_front(size: float, only: str) -> None:
    """Prints a line for each known change, and how many were named."""
    for name, pair in ONE_CAR.items():
        if only not in name:
            continue
        before, after = ([Log.read(folder() / file) for file in side] for side in pair)
        car = diagnose(before, effects=[]).simulator
        assert car is not None
        fitted = {"T_L": float(car.T_L), "K_L": float(car.K_L)}
        print(f"| {name}, untouched | {cell(compare(before, after).cause)} |", flush=True)
        named = alike = total = 0
        for number, effect in enumerate((GAIN, *IN_FRONT)):
            try:
                changed, truth = _changed(after, effect, fitted, size, number)
            except InputError:
                continue
            cause = compare(before, changed).cause
            hit = cause is not None and effect in cause.names
            alias = cause is not None and any(effect in part.alias_set for part in cause.parts)
            named, alike, total = named + hit, alike + alias, total + 1
            print(
                f"| {name}, {effect} {truth} | {'named' if hit else 'alias' if alias else 'missed'} | {cell(cause)} |"
            )
        print(f"{name}, size {size:g}: {named} of {total} named, {alike} with aliases", flush=True)


def _changed(
    logs: Sequence[Log], effect: str, car: Mapping[str, float], size: float, seed: int
) -> tuple[list[Log], str]:
    if effect == GAIN:
        ratio = 1 - 0.25 * size
        return [
            replace(log, accel_cmd=log.accel_cmd / ratio) for log in logs if log.accel_cmd is not None
        ], f"{ratio:g}"
    each = [put_in_front(log, effect, T_L=car["T_L"], K_L=car["K_L"], size=size, seed=seed) for log in logs]
    return [log for log, _ in each], ", ".join(f"{value:.3g}" for value in each[0][1].values())


def simulated(count: int, *, seed: int, seconds: float, recorder: str, only: str) -> None:
    """Prints a line for each pair of drives, and a table of shares with their 90 % intervals."""
    answers: dict[str, list[tuple[bool, bool, bool]]] = {}
    for index in range(count):
        rng = np.random.default_rng([seed, index])
        car, lacks = draw_car(rng), LACKS[index % len(LACKS)]
        written = draw_recorder(rng, 50.0) if recorder == "ordinary" else Recorder.ideal()
        manoeuvre = MANOEUVRES[index % len(MANOEUVRES)]
        for change in ("none", *CARS, *EFFECTS):
            if only not in change:
                continue
            after, effects = car, dict(lacks)
            if change in CARS:
                after = replace(car, **{change: CARS[change] * getattr(car, change)})
            elif change in EFFECTS:
                effects[change] = EFFECTS[change]
            logs = []
            for number, (one, has) in enumerate(((car, lacks), (after, effects))):
                plan = DrivePlan(manoeuvre, seconds, 50, 1000 * seed + 2 * index + number)
                logs.append(written.record(_drive(one, plan, has), seed=2 * index + number))
            cause = compare(*logs).cause
            names = () if cause is None else cause.names
            alike = cause is not None and any(change in part.alias_set for part in cause.parts)
            answers.setdefault(change, []).append((change in names, alike, not names))
            print(f"| {index} {manoeuvre} {car.T_L:.2f} {list(lacks)} | {change} | {cell(cause)} |", flush=True)
    for change, rows in answers.items():
        shares = [
            f"{label} {counted(sum(row[k] for row in rows), len(rows))}"
            for k, label in enumerate(("named", "in aliases", "none"))
        ]
        print(f"{change}: {'; '.join(shares)}")


def _drive(car: Car, plan: DrivePlan, effects: dict[str, dict[str, float]]) -> Log:
    run = simulate(car, plan.pilot(), seconds=plan.seconds, rate_hz=plan.rate_hz, effects=effects, seed=plan.seed)
    return Log.from_arrays(time=run.time, accel_cmd=run.command, accel=run.accel, speed=run.speed)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default="", help="pairs, or changes, with this in their name")
    parser.add_argument("--in-front", type=float, nargs="+", default=[], metavar="SIZE")
    parser.add_argument("--simulated", type=int, default=0, metavar="N", help="cars, each with every change")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--seconds", type=float, default=120.0, help="of either drive")
    parser.add_argument("--recorder", choices=("ideal", "ordinary"), default="ideal")
    given = parser.parse_args()
    if given.simulated:
        simulated(given.simulated, seed=given.seed, seconds=given.seconds, recorder=given.recorder, only=given.only)
        return
    for size in given.in_front:
        in_front(size, given.only)
    if not given.in_front:
        recordings(given.only)


if __name__ == "__main__":
    main()
