"""Does `avtorch.compare` report no change for an unchanged car, and detect a lag that is a fifth longer?

``python -m benchmarks.comparison [--n 40] [--seed 1] [--seconds 300] [--baseline PLANT] [--json FILE]``

Cars of the blind test's reference vehicle, without any cause, drive twice as long as `--seconds` in each of its
manoeuvres in turn. The first half is compared with the second, and with the second half of a drive of the same car
whose lag is 1.2 times as long. Shares come with their 90 % intervals (Wilson), and by manoeuvre.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from avtorch import Log, compare
from benchmarks.blindtest import MANOEUVRES, Case, draw_case, simulate
from benchmarks.blindtest.intervals import wilson

NONE = {"none": 1.0, "single": 0.0, "pair": 0.0, "outside": 0.0}
LONGER = 1.2


def slower(case: Case, *, seed: int) -> Log:
    """The same drive again by the same car with a longer lag and independent noise."""
    drive = case.drive
    car = replace(case.car, T_L=LONGER * case.car.T_L)
    run = simulate(car, drive.pilot(), seconds=drive.seconds, rate_hz=drive.rate_hz, seed=seed)
    return Log.from_arrays(
        name=f"{case.name}, slower", time=run.time, accel_cmd=run.command, accel=run.accel, speed=run.speed
    )


def tried(index: int, *, seed: int, seconds: float, baseline: str | None) -> dict[str, Any]:
    """One car: the comparisons with its own second half and with that of the slower car."""
    manoeuvre = list(MANOEUVRES)[index % len(MANOEUVRES)]
    case = draw_case(index, seed, mix=NONE, seconds=2 * seconds, manoeuvre=manoeuvre)
    log = case.log()
    half = slice(0, log.rows // 2), slice(log.rows // 2, log.rows)
    row: dict[str, Any] = {"case": case.name, "manoeuvre": manoeuvre, "T_L": case.car.T_L}
    for name, second in (("same", log), ("slower", slower(case, seed=seed + 1 + index))):
        found = compare(log[half[0]], second[half[1]], baseline=baseline)
        ratio = found.car["T_L"].ratio
        row[name] = {"changed": found.changed, "p_value": found.p_value, "T_L ratio": ratio.to_dict()}
    return row


def share(hits: Sequence[bool]) -> str:
    """Text of the form `hits of total, share (interval)`."""
    between = wilson(sum(hits), len(hits))
    if between is None:
        return "none"
    low, middle, high = (100 * x for x in (between[0], sum(hits) / len(hits), between[1]))
    return f"{sum(hits)} of {len(hits)}, {middle:.0f} % ({low:.0f} to {high:.0f})"


def inside(rows: Sequence[Any]) -> list[bool]:
    """Whether the 90 % of each ratio of lags holds the true one."""
    ratios = [(r[side]["T_L ratio"], true) for r in rows for side, true in (("same", 1.0), ("slower", LONGER))]
    return [ratio["q05"] <= true <= ratio["q95"] for ratio, true in ratios]


def main() -> None:
    """Run, print progress, and summarise."""
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("--n", type=int, default=40)
    arguments.add_argument("--seed", type=int, default=1)
    arguments.add_argument("--seconds", type=float, default=300.0, help="of either side")
    arguments.add_argument("--baseline", help="the simulator that both are compared with; default: GLVD")
    arguments.add_argument("--json", type=Path)
    given = arguments.parse_args()
    rows = []
    for index in range(given.n):
        rows.append(tried(index, seed=given.seed, seconds=given.seconds, baseline=given.baseline))
        print(json.dumps(rows[-1]), flush=True)
    if given.json:
        given.json.write_text(json.dumps(rows, indent=1) + "\n")
    groups = {"all": rows} | {m: [r for r in rows if r["manoeuvre"] == m] for m in MANOEUVRES}
    for name, some in groups.items():
        print(f"{name}: no change reported for the same car in {share([not r['same']['changed'] for r in some])}")
        print(f"{name}: a lag {LONGER:g} times as long found in {share([r['slower']['changed'] for r in some])}")
        print(f"{name}: the true ratio of T_L inside the 90 % in {share(inside(some))}")


if __name__ == "__main__":
    main()
