"""Does the proposed manoeuvre separate the causes that a drive does not? Tested on the blind test's reference vehicle.

``python -m benchmarks.next_experiment [--n 60] [--seed 1] [--seconds 60] [--json FILE]``

Draws sealed cases that followed a vehicle, diagnoses each, and where more than one named cause (or none at all) is
left, drives the proposed manoeuvre with the same car and the same cause: an open loop, with new noise and road.
Then both drives are diagnosed together. A case is separated if only the truth is left, and right if its verdict is the
truth; shares come with their 90 % intervals (Wilson). Cases where only `unknown` remained beside the verdict are
counted separately. So are those whose truth was among the remaining causes: a manoeuvre is not designed to separate a
truth that was excluded before.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from avtorch import diagnose
from avtorch.experiment import Experiment, Limits, next_experiment
from avtorch.io import Log
from benchmarks.blindtest import Case, Recorded, draw_cases, simulate
from benchmarks.blindtest.intervals import wilson

_LATER_S = 60.0  # after the log's end the manoeuvre begins


def driven(case: Case, experiment: Experiment, *, seed: int) -> Log:
    """Simulate the manoeuvre with the case's own car and cause, as the car would log it."""
    m = experiment.manoeuvre
    rate = case.drive.rate_hz
    times = np.arange(0.0, m.time[-1], 1 / rate)
    command = m.command[np.minimum(np.searchsorted(m.time, times + 1e-9, side="right") - 1, len(m.time) - 1)]
    effects: Mapping[str, Mapping[str, float]] = {
        name: {**values, "change_s": 0.0} if "change_s" in values else values
        for name, values in case.parameters.items()
    }
    pilot = Recorded(command, start_speed=float(m.speed[0]))
    run = simulate(case.car, pilot, seconds=len(command) / rate, rate_hz=rate, effects=effects, seed=seed)
    later = float(case.run.time[-1]) + _LATER_S
    return Log.from_arrays(
        name=f"{case.name}, manoeuvre",
        time=run.time + later,
        accel_cmd=run.command,
        accel=run.accel,
        speed=run.speed,
    )


def tried(case: Case, limits: Limits, *, seed: int) -> dict[str, Any]:
    """One case: the remaining causes before and after."""
    log = case.log()
    before = diagnose(log)
    named = [n for n in before.verdict.alias_set if n != "unknown"]
    row: dict[str, Any] = {
        "case": case.name,
        "truth": case.truth_name,
        "tier": case.tier,
        "before": list(before.verdict.alias_set),
        "confused": len(named) > 1,
    }
    if len(before.verdict.alias_set) < 2:
        return row
    experiment = next_experiment(before, limits)
    if experiment is None:
        return row
    after = diagnose([log, driven(case, experiment, seed=seed)])
    return row | {
        "manoeuvre": experiment.manoeuvre.name,
        "nats": experiment.information.nats,
        "margin": experiment.information.margin,
        "after": list(after.verdict.alias_set),
        "separated": after.verdict.alias_set == (case.truth_name,),
        "kept": case.truth_name in after.verdict.alias_set,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--n", type=int, default=60)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    rows = []
    mix = {"none": 0.2, "single": 0.6, "pair": 0.2, "outside": 0.0}
    for case in draw_cases(given.n, given.seed, mix=mix, seconds=given.seconds, manoeuvre="following"):
        row = tried(case, Limits(seconds=60.0), seed=given.seed + case.index)
        rows.append(row)
        print(json.dumps(row), flush=True)
    several = [r for r in rows if "after" in r and r["confused"]]
    for what, some in (
        ("several named", several),
        ("... the truth among them", [r for r in several if r["truth"] in r["before"]]),
        ("one named or none, and unknown", [r for r in rows if "after" in r and not r["confused"]]),
    ):
        for key, of in (("right before", "before"), ("right", "after"), ("separated", ""), ("kept", "")):
            hits = sum(r[of][0] == r["truth"] if of else r[key] for r in some)
            interval = wilson(hits, len(some))
            between = "" if interval is None else f" ({interval[0]:.2f} to {interval[1]:.2f})"
            print(f"{what}: {key} {hits} of {len(some)}{between}")
    if given.json:
        given.json.write_text(json.dumps(rows, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
