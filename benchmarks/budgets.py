"""The budget of the gap on recordings: each whole, and its halves by themselves; or with effects put in front.

``AVTORCH_DATA=DIR python -m benchmarks.budgets [--only TEXT] [--in-front SIZE ...]``

Prints a line a recording: the causes with their shares and parameters, and what each half says alone. With
``--in-front`` a line a known effect of that size, put in front of the recording: what is named, and what the untouched
recording is said to lack.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from avtorch.blindtest import IN_FRONT, put_in_front
from avtorch.errors import InputError
from avtorch.gap import Budget, gap_budget
from avtorch.io import Log

SETS: dict[str, tuple[str, ...]] = {
    "genesis, three laps": ("genesis/lap1.csv", "genesis/lap2.csv", "genesis/lap3.csv"),
    "genesis, lap 1": ("genesis/lap1.csv",),
    "genesis, lap 2": ("genesis/lap2.csv",),
    "genesis, lap 3": ("genesis/lap3.csv",),
    "indy_av21": ("indy_av21/Putnam_park2023_run4_2.csv",),
    "roboracer, one mass": ("roboracer/Normal_1weight.csv",),
    "roboracer, tyres": ("roboracer/tire_set_1.csv",),
    "roboracer, training": ("roboracer/ftg_stanley_total_training.csv",),
    "roboracer, validation": ("roboracer/ftg_stanley_total_validation.csv",),
    "dart, 10:02": ("dart/09_16_2024_10_02_28_onboard10Hz.csv",),
    "dart, 10:27": ("dart/09_16_2024_10_27_02_onboard10Hz.csv",),
    "volvo_truck": ("volvo_truck/052311_grade.csv",),
}
"""Recordings with commands, by name: the logs of one car."""


def causes(budget: Budget) -> str:
    """Causes with shares and parameters, in one cell of a table."""
    if not budget.names:
        return budget.verdict[0]
    cells: list[str] = []
    for part in budget.parts:
        if part.name in budget.names:
            values = [f"{q.mean:.3g} ({q.q05:.3g} to {q.q95:.3g})" for q in part.parameters.values()]
            cells.append(f"{part.name} {part.share.mean:.0%}: {', '.join(values)}")
    return "; ".join(cells)


def half(logs: Sequence[Log], which: int) -> list[Log]:
    """The first or the second half of each log."""
    return [log[slice(0, log.rows // 2) if which == 0 else slice(log.rows // 2, log.rows)] for log in logs]


def tried(logs: Sequence[Log]) -> str:
    try:
        budget = gap_budget(logs)
    except InputError as refusal:
        return f"({refusal})"
    return ", ".join(budget.names) or budget.verdict[0]


def in_front(logs: Sequence[Log], size: float) -> tuple[int, int]:
    """How many effects are named, of how many; prints a line each."""
    control = gap_budget(logs)
    T_L, K_L = control.baseline["T_L"], control.baseline["K_L"]
    held = total = 0
    for number, effect in enumerate(IN_FRONT):
        try:
            changed = [put_in_front(log, effect, T_L=T_L, K_L=K_L, size=size, seed=number) for log in logs]
        except InputError:
            continue
        budget = gap_budget([log for log, _ in changed])
        truth = ", ".join(f"{value:.3g}" for value in changed[0][1].values())
        named = effect in budget.names
        alike = any(effect in part.alias_set for part in budget.parts if part.name in budget.names)
        held, total = held + named, total + 1
        print(
            f"| {effect} ({truth}) | {'named' if named else 'alias' if alike else 'missed'} | {causes(budget)} |",
            flush=True,
        )
    return held, total


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default="", help="recordings with this in their name")
    parser.add_argument("--in-front", type=float, nargs="+", default=[], metavar="SIZE")
    arguments = parser.parse_args()
    folder = os.environ.get("AVTORCH_DATA")
    if folder is None:
        raise SystemExit("AVTORCH_DATA: not set, needs the folder of the recordings")
    for name, files in SETS.items():
        if arguments.only not in name:
            continue
        logs = [Log.read(Path(folder) / file) for file in files]
        if arguments.in_front:
            for size in arguments.in_front:
                held, total = in_front(logs, size)
                print(f"{name}, size {size:g}: {held} of {total} named", flush=True)
            continue
        begun = time.process_time()
        budget = gap_budget(logs)
        spent = time.process_time() - begun
        halves = " / ".join(tried(half(logs, which)) for which in (0, 1))
        share = f"{budget.before:.2f} to {budget.left:.2f}"
        unexplained = f"{budget.unexplained.share.mean:.0%}"
        seconds = np.sum([log.seconds for log in logs])
        print(
            f"| {name} | {seconds:.0f} | {share} | {causes(budget)} | {unexplained} | {halves} | {spent:.0f} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
