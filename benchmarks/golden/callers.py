"""Every way in, on one small example each: what calls the engine, and what it makes of its answer."""

from __future__ import annotations

import json
import re
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from avtorch import ExternalSimulator, Log, compare, compare_simulators, diagnose
from avtorch.experiment import next_experiment
from avtorch.external import FmuSimulator, wrap, write_fmu
from avtorch.fleet import FleetSettings, run_fleet
from avtorch.follower import diagnose_follower
from avtorch.gap import plant
from avtorch.io import read_following
from avtorch.pedals import fit_pedals
from benchmarks.golden import cars
from benchmarks.golden.facts import (
    Answer,
    comparison_facts,
    diagnosis_facts,
    tested_facts,
    timed,
)
from benchmarks.golden.recordings import first
from benchmarks.recordings import folder

TRAINING, OTHER_MASS = "roboracer/ftg_stanley_total_training.csv", "roboracer/single_mass.csv"


def truth(*names: str, **parameters: dict[str, float]) -> Answer:
    return {"truth": {"names": list(names) or ["none"], "parameters": parameters}}


def of(effects: cars.Effects) -> Answer:
    return truth(*effects, **{name: dict(values) for name, values in effects.items()})


def diagnosed(log: Log | list[Log], **settings: Any) -> Answer:
    found, took = timed(lambda: diagnose(log, progress=False, **settings))
    answer = found.to_dict()
    return diagnosis_facts(answer) | ({"more": tested_facts(answer)} if "simulator" in answer else {}) | took


def one_log() -> Answer:
    return of(cars.LATE) | diagnosed(cars.drive("late", cars.LATE, seed=1))


def accelerometer_only() -> Answer:
    return of(cars.LATE) | diagnosed(replace(cars.drive("late", cars.LATE, seed=1), speed=None))


def speed_only() -> Answer:
    return of(cars.DRAGGED) | diagnosed(replace(cars.drive("dragged", cars.DRAGGED, seed=2), accel=None))


def speed_in_whole_kmh() -> Answer:
    log = cars.drive("dragged", cars.DRAGGED, seed=2)
    assert log.speed is not None
    return of(cars.DRAGGED) | diagnosed(replace(log, accel=None, speed=(3.6 * log.speed).round() / 3.6))


def several_logs() -> Answer:
    return of(cars.DEAF) | diagnosed([cars.drive(f"drive {n}", cars.DEAF, seed=n) for n in (3, 4)])


def chosen_effects() -> Answer:
    log = cars.drive("tilted", cars.TILTED, seed=5)
    return of(cars.TILTED) | diagnosed(log, effects=["sensor_bias", "constant_resistance", "dead_time"], pairs=False)


def sampled() -> Answer:
    """By SGLD: the spread of the verdict's parameters, too."""
    log = cars.drive("late", cars.LATE, seed=1)
    found, took = timed(lambda: diagnose(log, posterior="sgld", progress=False))
    summary = found.summary().columns
    more = {f"sd {name}": sd for name, sd in zip(summary["parameter"], summary["sd"], strict=True)}
    return of(cars.LATE) | diagnosis_facts(found.to_dict()) | {"more": more} | took


def own_plant() -> Answer:
    """The user's simulator as a plant of effects, which has the delay already."""
    log = cars.drive("late and dragged", {**cars.LATE, **cars.DRAGGED}, seed=6)
    return of(cars.DRAGGED) | diagnosed(log, baseline="dead_time=0.25")


def by_output() -> Answer:
    """Of the user's simulator only its output is known."""
    log = cars.drive("car", {**cars.OWN, **cars.DRAGGED}, seed=8)
    assert log.accel_cmd is not None
    assert log.speed is not None
    simulator = ExternalSimulator(cars.output(log.accel_cmd, float(log.speed[0])))
    return of(cars.DRAGGED) | diagnosed(log, baseline=simulator)


def called() -> Answer:
    """The user's simulator is an object with `reset` and `step`; what was found is put around it."""
    log = cars.drive("dragged", cars.DRAGGED, seed=2)
    found, took = timed(lambda: diagnose(log, baseline=ExternalSimulator(cars.Lag), progress=False))
    answer = found.to_dict()
    more = tested_facts(answer)
    if found.plant is not None or (found.tested is not None and found.tested.wrong):
        better = wrap(cars.Lag(), found)
        better.reset(speed=20.0, accel=0.0)
        more["speed after 10 s at rest"] = [better.step(0.0, 0.05)[1] for _ in range(200)][-1]
    return of(cars.DRAGGED) | diagnosis_facts(answer) | {"more": more} | took


def adjusted() -> Answer:
    """The user's simulator has a wrong lag of its own, which may be adjusted."""
    log = cars.drive("slow", {}, seed=9, car=replace(cars.CAR, T_L=0.6))
    simulator = ExternalSimulator(cars.Lag, adjustable={"lag": (0.05, 2.0)})
    return truth() | diagnosed(log, baseline=simulator)


def fmu() -> Answer:
    log = cars.drive("dragged", cars.DRAGGED, seed=2)
    with tempfile.TemporaryDirectory() as where:
        path = write_fmu(plant([], T_L=0.3, K_L=0.95, sigma=0.0), Path(where, "car.fmu"))
        return of(cars.DRAGGED) | diagnosed(log, baseline=ExternalSimulator(FmuSimulator(path)))


def two_simulators() -> Answer:
    log = cars.drive("late", cars.LATE, seed=1)
    plain, late = ExternalSimulator(cars.Lag), "dead_time=0.25, T_L=0.3, K_L=0.95"
    found, took = timed(lambda: compare_simulators(log, plain, late, progress=False))
    more: Answer = {"ratio": found.ratio.mean, "p_first": found.p_first, "p_second": found.p_second}
    more |= {f"factor by {d.name}": d.ratio.mean for d in found.differences}
    return truth("second") | {"verdict": [str(found.nearer)], "more": more} | took


def compared(before: Log, after: Log) -> Answer:
    found, took = timed(lambda: compare(before, after, progress=False))
    return comparison_facts(found.to_dict()) | took


def change_of_an_effect() -> Answer:
    """Both drives of a car with a dead band; the later one also acts late."""
    before = cars.drive("before", cars.DEAF, seed=10, seconds=90)
    return of(cars.LATE) | compared(before, cars.drive("after", {**cars.DEAF, **cars.LATE}, seed=11, seconds=90))


def change_of_the_car() -> Answer:
    before, weak = cars.drive("before", {}, seed=12, seconds=90), replace(cars.CAR, K_L=0.76)
    return truth("K_L") | compared(before, cars.drive("after", {}, seed=13, seconds=90, car=weak))


def no_change() -> Answer:
    return truth("none") | compared(*(cars.drive(f"drive {n}", cars.DEAF, seed=n, seconds=90) for n in (14, 15)))


def another_mass() -> Answer:
    return compared(*(Log.read(folder() / file) for file in (TRAINING, OTHER_MASS)))


def followed(log: Log) -> Answer:
    found, took = timed(lambda: diagnose_follower(log, progress=False))
    assert found.diagnosis is not None
    more: Answer = {name: q.mean for name, q in found.parameters.items()}
    more |= {"law": found.law.name, "p_string_stable": found.usual.p_string_stable}
    return diagnosis_facts(found.diagnosis.to_dict()) | {"more": more} | took


def follower_simulated() -> Answer:
    """The other half has told the delay already."""
    return truth() | followed(cars.behind_a_leader())


def follower_recorded() -> Answer:
    """A production car at AstaZero; its cause is conditional on an assumed law."""
    return followed(first(read_following(folder() / "openacc_astazero/ASta_040719_platoon7.csv", vehicle=2), 150.0))


def experiment() -> Answer:
    """What to drive next after half a minute of cruise, in which drag and a constant resistance look alike."""
    log = cars.drive("cruise", cars.BRAKED_BY_AIR, seed=5, seconds=30, manoeuvre="cruise")
    some = ["aerodynamic_drag", "constant_resistance", "road_grade", "dead_time"]
    found, took = timed(lambda: diagnose(log, effects=some, pairs=False, progress=False))
    ahead, after = timed(lambda: next_experiment(found, progress=False))
    more: Answer = {"manoeuvre": None, "experiment's seconds": after["seconds"]}
    if ahead is not None:
        told = ahead.to_dict()
        more |= {key: told[key] for key in ("manoeuvre", "separates", "expected_information_nats", "entropy_nats")}
        more["expected_probability_of_truth"] = told["expected_probability_of_truth"]
    return of(cars.BRAKED_BY_AIR) | diagnosis_facts(found.to_dict()) | {"more": more} | took


def fleet() -> Answer:
    """Three cars: the verdict of each beside what it has."""
    have = {"sound": {}, "late": cars.LATE, "dragged": cars.DRAGGED}
    with tempfile.TemporaryDirectory() as where:
        paths = [Path(where, f"{name}.csv") for name in have]
        for path, (name, effects), seed in zip(paths, have.items(), (17, 1, 2), strict=True):
            cars.drive(name, effects, seed=seed).write(path)
        settings = FleetSettings(steps=("diagnose",))
        found, took = timed(lambda: run_fleet(paths, Path(where, "out"), settings=settings, workers=1, progress=False))
    more: Answer = {}
    named: list[str] = []
    for car in sorted(found["cars"], key=lambda car: car["car"]):
        verdict = (car["gap"] or {}).get("verdict") or ["no answer"]
        more[car["car"]] = "+".join(verdict)
        named += [f"{car['car']}: {'+'.join(sorted(verdict))}"]
    more |= {f"cars with {cause['name']}": cause.get("cars") for cause in found["causes"]}
    true = [f"{name}: {'+'.join(effects) or 'none'}" for name, effects in have.items()]
    return truth(*true) | {"verdict": named, "more": more} | took


def _command(*arguments: str) -> None:
    line = [sys.executable, "-m", "avtorch.cli", *arguments]
    done = subprocess.run(line, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"exit code {done.returncode}: {done.stderr.strip()[-300:]}")


def command_line() -> Answer:
    """`avtorch diagnose`, with the alarms of `avtorch estimate`: all files it writes, and the report's chapters."""
    log = cars.drive("late", cars.LATE, seed=1)
    with tempfile.TemporaryDirectory() as where:
        path, estimates, out = str(Path(where, "late.csv")), Path(where, "estimates"), Path(where, "out")
        log.write(path)
        _command("estimate", path, "--estimator", "map", "--out", str(estimates), "--quiet")
        told = ["--estimates", str(estimates / "estimates.json")]
        _, took = timed(lambda: _command("diagnose", path, *told, "--out", str(out), "--quiet"))
        return of(cars.LATE) | _written(out) | took


def command_line_by_output() -> Answer:
    """`avtorch diagnose --simulated`."""
    log = cars.drive("car", {**cars.OWN, **cars.DRAGGED}, seed=8)
    assert log.accel_cmd is not None
    assert log.speed is not None
    with tempfile.TemporaryDirectory() as where:
        path, own, out = str(Path(where, "car.csv")), str(Path(where, "own.csv")), Path(where, "out")
        log.write(path)
        cars.output(log.accel_cmd, float(log.speed[0])).write(own)
        _, took = timed(lambda: _command("diagnose", path, "--simulated", own, "--out", str(out), "--quiet"))
        return of(cars.DRAGGED) | _written(out) | took


def _written(out: Path) -> Answer:
    answer = json.loads((out / "diagnosis.json").read_text(encoding="utf-8"))
    page = (out / "report.html").read_text(encoding="utf-8")
    more: Answer = tested_facts(answer) if "simulator" in answer else {}
    more["files"] = sorted(path.name for path in out.iterdir() if not path.name.startswith("."))
    more["chapters"] = [re.sub(r"<[^>]+>", "", x).strip() for x in re.findall(r"<h2[^>]*>(.*?)</h2>", page, re.S)]
    more["pictures"] = len(re.findall(r"<svg|<img", page))
    more["next_experiment"] = (answer["next_experiment"] or {}).get("manoeuvre")
    more["schema"] = answer["schema"]
    return diagnosis_facts(answer) | {"more": more}


def pedals() -> Answer:
    """A log of throttle and speed alone, whose map to an acceleration is fitted first."""
    log = first(Log.read(folder() / "dart/09_16_2024_10_02_28_onboard10Hz.csv"), 70.0)
    log = replace(log, accel_cmd=None)
    fit = fit_pedals(log)
    return diagnosed(fit.map.commanded(log)) | {"more": {"by": list(fit.map.pedals)}}


CALLERS: dict[str, Callable[[], Answer]] = {
    "diagnose": one_log,
    "diagnose, accelerometer only": accelerometer_only,
    "diagnose, speed only": speed_only,
    "diagnose, speed in whole km/h": speed_in_whole_kmh,
    "diagnose, two logs of a car": several_logs,
    "diagnose, three effects, no pairs": chosen_effects,
    "diagnose, sgld": sampled,
    "diagnose, own plant": own_plant,
    "simulator by output": by_output,
    "simulator called": called,
    "simulator adjusted": adjusted,
    "simulator as FMU": fmu,
    "compare_simulators": two_simulators,
    "compare, an effect": change_of_an_effect,
    "compare, K_L": change_of_the_car,
    "compare, nothing": no_change,
    "compare, RoboRacer with another mass": another_mass,
    "follower, simulated": follower_simulated,
    "follower, AstaZero": follower_recorded,
    "next experiment": experiment,
    "fleet of three": fleet,
    "command line, report": command_line,
    "command line, --simulated": command_line_by_output,
    "pedals, DART": pedals,
}


def cases() -> Iterator[tuple[str, Callable[[], Answer]]]:
    for name, work in CALLERS.items():
        yield f"callers/{name}", work
