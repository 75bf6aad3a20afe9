"""The budget of the gap on recordings: each whole, and its halves by themselves; or with effects put in front.

``AVTORCH_DATA=DIR python -m benchmarks.budgets [--only TEXT] [--in-front SIZE ...] [--picture FILE]``

Prints a line a recording: the causes with their shares and parameters, and what each half says alone. With
``--in-front`` a line a known effect of that size, put in front of the recording as one car's, several logs as segments
of one: what is named, the size found on top of the untouched recording's over the size put in, the same on top of what
the untouched recording has where the same effects are fitted to it, names that neither the effect nor the untouched
recording accounts for, and what the simplest selection names (`reference_selection`).
``--picture`` draws the budget and the drive of the first recording, as `avtorch diagnose` answers, and no more.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from avtorch import diagnose, plots
from avtorch.blindtest import IN_FRONT, put_in_front
from avtorch.blindtest.in_front_score import SIZE_OF, SIZE_WITHIN
from avtorch.errors import InputError
from avtorch.gap import EFFECTS, Budget, gap_budget, plant
from avtorch.gap.budget.analysis_record import AnalysisRecord
from avtorch.gap.budget.forward_selection import baseline_noise
from avtorch.gap.budget.given_effects import given_effects
from avtorch.gap.budget.own_noise import own_noise, with_sizes
from avtorch.gap.budget.repaired_model import parameters_of
from avtorch.gap.budget.robust_fit import Fit, RobustFit
from avtorch.io import Log
from benchmarks.reference_selection import selected

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
_BETWEEN_S = 5.0


def causes(budget: Budget) -> str:
    """Causes with shares and parameters, in one cell of a table."""
    if not budget.names:
        return budget.verdict[0]
    cells: list[str] = []
    for part in budget.parts:
        if part.name in budget.names:
            values = [f"{q.mean:.3g} ({q.q05:.3g} to {q.q95:.3g})" for q in part.parameters.values()]
            cells.append(f"{part.name} {part.share.mean:.0%}: {', '.join(values)}")
    cells += [f"{part.name}, by chance" for part in budget.chance if part.name in budget.names]
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


def in_front(log: Log, size: float) -> None:
    """Prints a line per effect, and a last one with the counts."""
    control, alone = gap_budget(log), baseline_noise(AnalysisRecord.for_budget([log]), plant([]))
    simple_control = selected([log])
    print(f"| untouched | | | | | {causes(control)} | {', '.join(simple_control) or 'none'} |", flush=True)
    T_L, K_L = control.baseline["T_L"], control.baseline["K_L"]
    tried = named = sized = matched = extra = simple = simple_extra = 0
    for number, effect in enumerate(IN_FRONT):
        if EFFECTS[effect].random:
            continue
        try:
            changed, put_in = put_in_front(log, effect, T_L=T_L, K_L=K_L, size=size, seed=number)
            budget = gap_budget(changed)
        except InputError:
            continue
        others = [name for name in budget.names if name != effect and name not in control.names]
        reference = list(selected([changed]))
        ratio = _ratio(budget, control, effect, put_in)
        same = _same_effects(budget, alone, effect, put_in, changed.epoch_s)
        held = effect in budget.names
        each = (*budget.parts, *budget.chance)
        alike = any(effect in part.alias_set for part in each if part.name in budget.names)
        tried, named, extra = tried + 1, named + held, extra + bool(others)
        sized += ratio is not None and abs(ratio - 1) <= SIZE_WITHIN
        matched += same is not None and abs(same - 1) <= SIZE_WITHIN
        simple += effect in reference
        simple_extra += any(name != effect and name not in simple_control for name in reference)
        truth = ", ".join(f"{value:.3g}" for value in put_in.values())
        print(
            f"| {effect} ({truth}) | {'named' if held else 'alias' if alike else 'missed'} | "
            f"{'' if ratio is None else f'{ratio:.2f}'} | {'' if same is None else f'{same:.2f}'} | "
            f"{', '.join(others)} | {causes(budget)} | "
            f"{', '.join(reference) or 'none'} |",
            flush=True,
        )
    print(
        f"named {named} of {tried}, of these {sized} within 25 % in size, {matched} beside the same effects; ", end=""
    )
    print(f"with others {extra}")
    print(f"the simplest selection: named {simple} of {tried}, with others {simple_extra}", flush=True)


def _ratio(budget: Budget, control: Budget, effect: str, put_in: Mapping[str, float]) -> float | None:
    """The size found on top of the control's, over what was put in."""
    key, without, relative = SIZE_OF[effect]
    found, before = _size(budget, effect, key), _size(control, effect, key)
    return None if found is None else relative(found, without if before is None else before, put_in[key])


def _same_effects(
    budget: Budget, alone: tuple[RobustFit, Fit], effect: str, put_in: Mapping[str, float], epoch_s: float
) -> float | None:
    """As `_ratio`, on top of what the untouched recording has of the effect when the same effects are fitted to it.

    `alone`: its noise and its bare baseline. What a car has of an effect may be too little to be named.
    """
    key, _, relative = SIZE_OF[effect]
    found = _size(budget, effect, key)
    if found is None:
        return None
    parts = [part for part in budget.parts if part.name in budget.names]
    values = {f"{part.name}.{name}": q.mean for part in parts for name, q in part.parameters.items()}
    onsets = {part.name: part.onset_s - epoch_s for part in parts if part.onset_s is not None}
    kinds = [EFFECTS[part.name] for part in parts]
    selection = given_effects(*alone, kinds, values=values, onsets=onsets)
    selection = with_sizes(replace(selection, judging=own_noise(selection.last.fit)))
    return relative(found, parameters_of(selection, effect)[key].mean, put_in[key])


def _size(budget: Budget, effect: str, key: str) -> float | None:
    part = next((part for part in budget.parts if part.name == effect and effect in budget.names), None)
    return None if part is None or key not in part.parameters else part.parameters[key].mean


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default="", help="recordings with this in their name")
    parser.add_argument("--in-front", type=float, nargs="+", default=[], metavar="SIZE")
    parser.add_argument("--picture", metavar="FILE")
    arguments = parser.parse_args()
    folder = os.environ.get("AVTORCH_DATA")
    if folder is None:
        raise SystemExit("AVTORCH_DATA: not set, needs the folder of the recordings")
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
