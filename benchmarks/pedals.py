"""Maps of pedals on recordings whose command is no acceleration, and on a car with a known one.

``AVTORCH_DATA=DIR python -m benchmarks.pedals [--only TEXT]``

Every other stretch of about 20 s teaches; over the rest the map runs free for 10 s at a time, begun at the measured
speed after 3 s in which it sees what was measured. A line a recording: the root mean square error of speed
[m/s], lag and dead time with their sum's standard error, and processor seconds of the fit.
The known car has a lag of 0.4 s and a dead time of 0.1 s; behind the ordinary recorder its speed is 20 ms old, goes
through a filter of 50 ms, is held for 100 ms and rounded to 0.02 m/s.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from scipy.signal import lfilter

from avtorch.arrays import FloatArray
from avtorch.errors import InputError
from avtorch.io import Log
from avtorch.pedals import PedalMap, fit_pedals
from avtorch.pedals.pedal_map import inputs_of
from benchmarks.recordings import SETS, folder
from benchmarks.repair import FREE_S, SLOWEST_HZ, WARM_S, pieces
from tests.pedals import cars

_AV21 = {"map": ["throttle=throttle_pct", "brake=brake_kPa"], "unit": ["throttle=%", "brake=kPa"]}
_ROBORACER = {"map": ["current=current_A"]}
RECORDINGS: dict[str, tuple[str, dict[str, Any]]] = {
    "AV-21": (SETS["indy_av21"][0], _AV21),
    **{name: (SETS[name][0], _ROBORACER) for name in SETS if name.startswith("roboracer")},
    **{name: (SETS[name][0], {}) for name in SETS if name.startswith("dart")},
    "volvo_truck": (SETS["volvo_truck"][0], {"map": ["torque=engine_torque_cmd_Nm"]}),
    "volvo_truck, its reference speed": (SETS["volvo_truck"][0], {"map": ["speed_cmd=ref_v"]}),
}
"""Recordings by name: the file, and how its pedals are read."""


def read(name: str, root: Path) -> Log:
    """A recording, without its nominal command."""
    file, options = RECORDINGS[name]
    return replace(Log.read(root / file, **options), accel_cmd=None)


def known(car: cars.Demand, seed: int, *, ordinary: bool) -> Log:
    """A drive of a car with a known map."""
    log = cars.drive(car, seed)
    assert log.speed is not None
    if not ordinary:
        return log
    keep, time = np.exp(-cars.DT / 0.05), log.elapsed
    v = lfilter([1 - keep], [1, -keep], log.speed, zi=[keep * log.speed[0]])[0]
    v = np.interp(time - 0.02, time, v)[2 * (np.arange(log.rows) // 2)]
    return replace(log, speed=0.02 * np.round(v / 0.02))


def free_run(made: PedalMap, inputs: dict[str, FloatArray], speed: FloatArray, warm: int, dt: float) -> FloatArray:
    """Errors of speed (row,) [m/s] from row `warm` on; the missing speed of a loop is that of the run."""
    late, keep = made.dead_time / dt, np.exp(-dt / made.T_L)
    v, demands, out = float(speed[0]), [], []
    first = min(5, len(speed) - 1)
    a = float(speed[first] - speed[0]) / (first * dt)
    for i in range(len(speed) - 1):
        now = {name: x[i : i + 1] for name, x in inputs.items()}
        if "speed_error" in now:
            now["speed_error"] = now["speed_error"] + speed[i] - v
        demands.append(now)

        def demand(rows: int, v: float = v, demands: list[dict[str, FloatArray]] = demands) -> float:
            return float(made.accel(np.array([max(v, 0.0)]), **demands[max(len(demands) - 1 - rows, 0)])[0])

        part = late - int(late)
        m = (1 - part) * demand(int(late)) + part * demand(int(late) + 1)
        after = keep * a + (1 - keep) * m
        v = max(v + m * dt + (a - m) * made.T_L * (1 - keep), 0.0) if i >= warm else float(speed[i + 1])
        a = after
        if i >= warm:
            out.append(v - speed[i + 1])
    return np.array(out)


def line(name: str, log: Log) -> str:
    """The line of a recording."""
    parts, begun = pieces(log), time.process_time()
    taught = np.zeros(log.rows)
    for part in parts[0::2]:
        taught[part] = 1.0
    fit = fit_pedals(replace(log, engaged=log.engaged & (taught > 0)))
    seconds = time.process_time() - begun
    thin = max(1, round(log.rate_hz / SLOWEST_HZ))
    dt = thin / log.rate_hz
    warm, free = round(WARM_S / dt), round(FREE_S / dt)
    given = inputs_of(log, fit.map.pedals)
    errors: list[FloatArray] = []
    for part in parts[1::2]:
        rows, at = np.arange(part.start, part.stop)[::thin], 0
        while at + warm + free // 3 <= len(rows):
            run = rows[at : at + warm + free]
            ok = log.usable[run]
            run = run if ok.all() else run[: int(np.argmin(ok))]
            if len(run) < warm + free // 3:
                at += len(run) + 1
                continue
            at += free
            assert log.speed is not None
            inputs = {name: x[run] for name, x in given.items() if x is not None}
            errors.append(free_run(fit.map, inputs, log.speed[run], warm, dt))
    if not errors:
        raise InputError("no run of a third of the time or more on what taught nothing")
    cells = [name, f"{len(errors)}", f"{np.sqrt(np.mean(np.concatenate(errors) ** 2)):.3f}"]
    cells += [f"{fit.map.T_L:.2f}", f"{fit.map.dead_time:.2f}", f"± {fit.late_sd:.2f}", f"{seconds:.0f} s"]
    return f"| {' | '.join(cells)} |"


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--only", default="")
    given = parser.parse_args(arguments)
    logs: dict[str, Callable[[], Log]] = {name: partial(read, name, folder()) for name in RECORDINGS}
    for car, seed, ordinary in product((cars.plain, cars.with_dead_zone), (101, 102), (False, True)):
        recorder = "ordinary" if ordinary else "ideal"
        logs[f"known car, {car.__name__}, {recorder} recorder, {seed}"] = partial(known, car, seed, ordinary=ordinary)
    for name, log in logs.items():
        if given.only in name:
            try:
                print(line(name, log()), flush=True)
            except InputError as fault:
                print(f"| {name} | {fault} |", flush=True)


if __name__ == "__main__":
    main()
