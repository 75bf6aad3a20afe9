"""Does the order of controllers carry over from a simulator to the car, before and after the simulator is repaired?

``python -m benchmarks.ranking [--cars 10] [--seed 3] [--foreign] [--json FILE]``

Ten gain settings follow a leader (part of US06) in closed loop: on the reference vehicle of the blind test, whose
equations avtorch does not share; in the simulator as an engineer has it before any log (T_L 0.3 s, K_L 1); in the same
with lag and gain fitted to a log of the car; and in the repaired one that `diagnose` hands back from that log. Each car
has one or two effects. Scores, less is better: RMS spacing error [m], RMS acceleration over the leader's [-], peak
braking [m/s²]. With ``--foreign`` the car is CommonRoad's multi-body model of a BMW 320i
(``pip install commonroad-vehicle-models``), written by others, behind a dead time and a lag of its brake and engine.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from avtorch import Leader, diagnose
from avtorch.arrays import FloatArray
from avtorch.experiment import rank_agreement
from avtorch.external.simulator import DrivenPlant, Simulator
from avtorch.gap import GapPlant, plant
from avtorch.io import Log
from benchmarks.blindtest import draw_case
from benchmarks.simulators.vehicle import OWN, SteppedVehicle

DT_S = 0.05
STANDSTILL_M = 5.0
SETTINGS = {
    f"k_s {k_s}, k_v {k_v}, k_a {k_a}, tau {tau}": (k_s, k_v, k_a, tau)
    for k_s, k_v, k_a, tau in (
        (1.5, 1.5, -0.8, 1.0),
        (0.2, 0.6, 0.0, 1.0),
        (0.4, 1.0, 0.0, 1.0),
        (0.8, 1.2, -0.3, 1.0),
        (1.0, 2.0, -0.5, 1.0),
        (2.5, 1.5, -0.8, 1.0),
        (0.4, 1.0, 0.0, 0.6),
        (1.5, 1.5, -0.8, 0.6),
        (0.8, 1.2, -0.3, 1.6),
        (2.0, 3.0, 0.0, 1.0),
    )
}
"""Gains k_s [1/s²], k_v [1/s], k_a [-], and the time gap [s]."""
SCORES = ("spacing [m]", "acceleration ratio [-]", "braking [m/s²]")


def follow(car: Simulator, lead: FloatArray, setting: Sequence[float]) -> dict[str, float]:
    """Scores of a setting behind a leader of speed `lead` (row,) [m/s]."""
    k_s, k_v, k_a, tau = setting
    speed, accel = float(lead[0]), 0.0
    car.reset(speed=speed, accel=accel)
    spacing = STANDSTILL_M + tau * speed
    errors, accels = [], []
    for before, ahead in pairwise(lead.tolist()):
        error = spacing - STANDSTILL_M - tau * speed
        command = min(max(k_s * error + k_v * (before - speed) + k_a * accel, -6.0), 4.0)
        last = speed
        accel, speed = car.step(command, DT_S)
        spacing += DT_S * 0.5 * (before + ahead - last - speed)
        errors.append(error)
        accels.append(accel)
    of_lead = float(np.std(np.diff(lead) / DT_S))
    e, a = np.array(errors), np.array(accels)
    return dict(zip(SCORES, (math.sqrt(np.mean(e**2)), float(a.std()) / of_lead, float(-a.min())), strict=True))


def scores(car: Simulator, lead: FloatArray) -> dict[str, dict[str, float]]:
    """By score, then by setting."""
    found = {name: follow(car, lead, setting) for name, setting in SETTINGS.items()}
    return {score: {name: each[score] for name, each in found.items()} for score in SCORES}


def simulators(log: Log, seed: int) -> tuple[dict[str, GapPlant], str]:
    """The three simulators, and what was named."""
    found = diagnose(log, seed=seed, progress=False)
    fitted = plant([], T_L=found.baseline["T_L"].mean, K_L=found.baseline["K_L"].mean, sigma=0.0)
    sets = {"as before any log": plant([], T_L=0.3, K_L=1.0, sigma=0.0), "lag and gain fitted": fitted}
    return sets | {"repaired": _unread(found.plant or fitted)}, found.verdict.name


def _unread(car: GapPlant) -> GapPlant:
    """Without what is the sensor's and chance's: the controllers are fed true motion on every side."""
    kept = [e for e in car.effects if e.place != "sensor" and not e.random]
    return GapPlant(kept, T_L=car.T_L, K_L=car.K_L, sigma=0.0)


def compared(car: Simulator, log: Log, lead: FloatArray, seed: int) -> tuple[dict[str, Any], str]:
    """Rank agreement and regret by simulator and score."""
    real = scores(car, lead)
    sets, named = simulators(log, seed)
    out = {}
    for name, simulator in sets.items():
        each = scores(DrivenPlant(simulator), lead)
        found = {score: rank_agreement(each[score], real[score]) for score in SCORES}
        out[name] = {s: {"srcc": x.srcc, "regret": x.regret / min(real[s].values())} for s, x in found.items()}
    return out, named


class MultiBody:
    """CommonRoad's multi-body car, straight ahead. Its own input is an acceleration by torque at the wheels; before it
    a dead time and a lag, as engine and brake have them, in this file's own arithmetic."""

    DEAD_S, LAG_S, STEP_S = 0.2, 0.35, 0.001

    def __init__(self) -> None:
        from vehiclemodels.init_mb import init_mb  # pyright: ignore[reportMissingImports]
        from vehiclemodels.parameters_vehicle2 import parameters_vehicle2  # pyright: ignore[reportMissingImports]
        from vehiclemodels.vehicle_dynamics_mb import vehicle_dynamics_mb  # pyright: ignore[reportMissingImports]

        self._p, self._init, self._slope = parameters_vehicle2(), init_mb, vehicle_dynamics_mb

    def reset(self, *, speed: float, accel: float) -> None:
        self._x = np.array(self._init([0.0, 0.0, 0.0, max(speed, 0.5), 0.0, 0.0, 0.0], self._p))
        self._torque = accel
        self._transit = [accel] * round(self.DEAD_S / self.STEP_S)

    def step(self, accel_cmd: float, dt: float) -> tuple[float, float]:
        before = self._x[3]
        for _ in range(round(dt / self.STEP_S)):
            self._transit.append(accel_cmd)
            self._torque += self.STEP_S / self.LAG_S * (self._transit.pop(0) - self._torque)
            self._x = self._x + self.STEP_S * np.array(self._slope(self._x, [0.0, self._torque], self._p))
        return float((self._x[3] - before) / dt), float(self._x[3])


def foreign_log(car: Simulator, seed: int) -> Log:
    """A drive of steps and ramps, 90 s at 20 Hz, with sensor noise."""
    rng = np.random.default_rng(seed)
    accel, speed = 0.0, 15.0
    car.reset(speed=speed, accel=accel)
    levels = np.repeat(rng.uniform(-2.0, 1.8, 36), 50)
    rows = []
    for k, level in enumerate(levels):
        command = float(level - 0.15 * (speed - 15.0))
        rows.append((k * DT_S, command, accel, speed))
        accel, speed = car.step(command, DT_S)
    time, command, accel_, speed_ = np.array(rows).T
    noisy = accel_ + 0.03 * rng.standard_normal(len(time)), speed_ + 0.02 * rng.standard_normal(len(time))
    return Log.from_arrays(name="multi-body", time=time, accel_cmd=command, accel=noisy[0], speed=noisy[1])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cars", type=int, default=10)
    parser.add_argument("--seed", type=int, default=3)
    parser.add_argument("--foreign", action="store_true")
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    lead = np.asarray(Leader.default(start=55.0, duration=70.0, dt=DT_S).speed, float)
    found: list[dict[str, Any]] = []
    for k in range(1 if given.foreign else given.cars):
        if given.foreign:
            car: Simulator = MultiBody()
            truth, log = "multi-body", foreign_log(car, given.seed)
        else:
            kind = ("single", "pair")[k % 2]
            case = draw_case(k, given.seed, mix={kind: 1.0}, effects=sorted(OWN), tiers=["easy", "hard"], seconds=60.0)
            car, truth, log = SteppedVehicle(case.car, case.parameters), case.truth_name, case.log()
        each, named = compared(car, log, lead, given.seed)
        found.append({"truth": truth, "named": named, "simulators": each})
        print(f"{truth} (named {named})")
        for name, of in each.items():
            print(
                f"  {name:20}",
                *(f"{s}: {x['srcc']:+.2f} (regret {100 * x['regret']:.0f} %)" for s, x in of.items()),
                sep="  ",
                flush=True,
            )
    print("\nMean over cars: rank correlation (regret, as a share of the best score)")
    for name in found[0]["simulators"]:
        print(f"  {name:20}", *(_mean(found, name, score) for score in SCORES), sep="  ")
    if given.json is not None:
        given.json.write_text(json.dumps(found, indent=1), encoding="utf-8")


def _mean(found: Sequence[Mapping[str, Any]], name: str, score: str) -> str:
    each = [one["simulators"][name][score] for one in found]
    srcc, regret = (float(np.mean([x[key] for x in each])) for key in ("srcc", "regret"))
    least = min(x["srcc"] for x in each)
    return f"{score}: {srcc:+.2f} (least {least:+.2f}; regret {100 * regret:.1f} %)"


if __name__ == "__main__":
    main()
