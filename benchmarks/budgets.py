"""The budget of the gap on recordings: each whole, and its halves by themselves; or with effects put in front.

``AVTORCH_DATA=DIR python -m benchmarks.budgets [--only TEXT] [--in-front SIZE ...] [--picture FILE]``

Prints a row a recording: the causes with their shares and parameters, and what each half says alone; and then what is
known of these cars by other means (`known_facts`), a row a fact, beside the budget's figure.

With ``--in-front`` a row a known effect of that size, put in front of the recording as one car's, several logs as
segments of one: what is named; the size found on top of the untouched recording's over the size put in, and whether its
90 % interval holds what was put in; both on top of what the untouched recording has where the same effects are fitted
to it; names that neither the effect nor the untouched recording accounts for; what the simplest selection names
(`reference_selection`). Then the counts, with 90 % intervals.

``--picture`` draws the budget and the drive of the first recording, as `avtorch diagnose` answers, and no more.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from avtorch import diagnose, plots
from avtorch.errors import InputError
from avtorch.gap import gap_budget
from avtorch.io import Log
from benchmarks.budget_cells import causes
from benchmarks.effects_in_front import in_front
from benchmarks.known_facts import HEADER as FACTS_HEADER
from benchmarks.known_facts import Told, closing, told

SETS: dict[str, tuple[str, ...]] = {
    "genesis, three laps": ("genesis/lap1.csv", "genesis/lap2.csv", "genesis/lap3.csv"),
    "genesis, lap 1": ("genesis/lap1.csv",),
    "genesis, lap 2": ("genesis/lap2.csv",),
    "genesis, lap 3": ("genesis/lap3.csv",),
    "indy_av21": ("indy_av21/Putnam_park2023_run4_2.csv",),
    "roboracer, one mass": ("roboracer/Normal_1weight.csv",),
    "roboracer, other mass": ("roboracer/single_mass.csv",),
    "roboracer, tyres": ("roboracer/tire_set_1.csv",),
    "roboracer, training": ("roboracer/ftg_stanley_total_training.csv",),
    "roboracer, validation": ("roboracer/ftg_stanley_total_validation.csv",),
    "dart, 10:02": ("dart/09_16_2024_10_02_28_onboard10Hz.csv",),
    "dart, 10:27": ("dart/09_16_2024_10_27_02_onboard10Hz.csv",),
    "dart, 10:02, motion capture": ("dart/09_16_2024_10_02_28_vicon50Hz.csv",),
    "dart, 10:27, motion capture": ("dart/09_16_2024_10_27_02_vicon50Hz.csv",),
    "volvo_truck": ("volvo_truck/052311_grade.csv",),
}
"""Recordings with commands, by name: the logs of one car."""
HEADER = (
    "| recording | s | error before, left | causes | unexplained | first half / second half | processor s |\n"
    "|---|---|---|---|---|---|---|"
)
_BETWEEN_S = 5.0


def half(logs: Sequence[Log], which: int) -> list[Log]:
    """The first or the second half of each log."""
    return [log[slice(0, log.rows // 2) if which == 0 else slice(log.rows // 2, log.rows)] for log in logs]


def tried(logs: Sequence[Log]) -> str:
    try:
        budget = gap_budget(logs)
    except InputError as refusal:
        return f"({refusal})"
    return ", ".join(budget.names) or budget.verdict[0]


def joined(logs: Sequence[Log]) -> Log:
    """One log of several, each a segment, with some seconds between them."""
    if len(logs) == 1:
        return logs[0]
    ends = np.cumsum([0.0, *(log.seconds + _BETWEEN_S for log in logs)])
    columns: dict[str, Any] = {
        name: np.concatenate([getattr(log, name) for log in logs])
        for name in ("accel_cmd", "speed", "accel", "engaged")
        if all(getattr(log, name, None) is not None for log in logs)
    }
    time = np.concatenate([log.elapsed - log.elapsed[0] + end for log, end in zip(logs, ends[:-1], strict=True)])
    segment = np.concatenate([np.full(log.rows, number) for number, log in enumerate(logs)])
    return Log.from_arrays(name=logs[0].name, time=time, segment=segment, **columns)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default="", help="recordings with this in their name")
    parser.add_argument("--in-front", type=float, nargs="+", default=[], metavar="SIZE")
    parser.add_argument("--picture", metavar="FILE")
    arguments = parser.parse_args()
    folder = os.environ.get("AVTORCH_DATA")
    if folder is None:
        raise SystemExit("AVTORCH_DATA: not set, needs the folder of the recordings")
    if not (arguments.picture or arguments.in_front):
        print(HEADER, flush=True)
    facts: list[Told] = []
    for name, files in SETS.items():
        if arguments.only not in name:
            continue
        logs = [Log.read(Path(folder) / file) for file in files]
        if arguments.picture:
            plots.save(plots.diagnosis_figure(diagnose(logs)), arguments.picture)
            return
        if arguments.in_front:
            for size in arguments.in_front:
                print(f"{name}, size {size:g}", flush=True)
                in_front(joined(logs), size)
            continue
        begun = time.process_time()
        try:
            budget = gap_budget(logs)
        except InputError as fault:
            print(f"| {name} | | | ({fault}) | | | |", flush=True)
            continue
        spent = time.process_time() - begun
        halves = " / ".join(tried(half(logs, which)) for which in (0, 1))
        share = f"{budget.before:.2f} to {budget.left:.2f}"
        unexplained = f"{budget.unexplained.share.mean:.0%}"
        seconds = np.sum([log.seconds for log in logs])
        print(
            f"| {name} | {seconds:.0f} | {share} | {causes(budget)} | {unexplained} | {halves} | {spent:.0f} |",
            flush=True,
        )
        facts += told(name, budget)
    if facts:
        print("\n".join(["", FACTS_HEADER, *map(str, facts), "", closing(facts)]), flush=True)


if __name__ == "__main__":
    main()
