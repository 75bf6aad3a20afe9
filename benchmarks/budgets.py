"""The budget of the gap on recordings: each whole, and its halves by themselves; or with effects put in front.

``AVTORCH_DATA=DIR python -m benchmarks.budgets [--only TEXT] [--in-front SIZE ...] [--picture FILE]``

Prints a row a recording: the causes with their shares and parameters; what each half says alone, how many families are
there in both halves of those in either, and of those with a size in both how many have overlapping 90 % intervals; then
what is known of these cars by other means (`known_facts`), a row a fact, beside the budget's figure.

With ``--in-front`` a row a known effect of that size, put in front of the recording as one car's, several logs as
segments of one: what is named; the size found on top of the untouched recording's over the size put in, and whether its
90 % interval holds what was put in; both on top of what the untouched recording has where the same effects are fitted
to it; names that neither the effect nor the untouched recording accounts for; what the simplest selection names
(`reference_selection`). Then the counts, with 90 % intervals.

``--picture`` draws the budget and the drive of the first recording, as `avtorch diagnose` answers, and no more.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence

import numpy as np

from avtorch import diagnose, plots
from avtorch.errors import InputError
from avtorch.gap.result.budget import Budget
from avtorch.io import Log
from benchmarks.budget_cells import causes
from benchmarks.effects_in_front import in_front
from benchmarks.known_facts import HEADER as FACTS_HEADER
from benchmarks.known_facts import Told, closing, told
from benchmarks.recordings import SETS, folder, joined

HEADER = (
    "| recording | s | error before, left | causes | unexplained | first half / second half | families | seconds |\n"
    "|---|---|---|---|---|---|---|---|"
)


def half(logs: Sequence[Log], which: int) -> list[Log]:
    """The first or the second half of each log."""
    return [log[slice(0, log.rows // 2) if which == 0 else slice(log.rows // 2, log.rows)] for log in logs]


def tried(logs: Sequence[Log]) -> Budget | str:
    """The budget, or why there is none."""
    try:
        return diagnose(logs).budget or "(too short to hold out five blocks of 4 s)"
    except InputError as refusal:
        return f"({refusal})"


def said(budget: Budget | str) -> str:
    return budget if isinstance(budget, str) else ", ".join(budget.names) or budget.verdict[0]


def families_alike(one: Budget | str, other: Budget | str) -> tuple[int, int, int, int]:
    """Families that are there in both halves, in either; with sizes that agree, with sizes in both."""
    if isinstance(one, str) or isinstance(other, str):
        return 0, 0, 0, 0
    mine, others = ({f.family: f.size_mps2 for f in budget.families if f.present} for budget in (one, other))
    both = [(mine[name], others[name]) for name in mine.keys() & others.keys()]
    agree = [max(a.q05, b.q05) <= min(a.q95, b.q95) for a, b in both if a is not None and b is not None]
    return len(both), len(mine.keys() | others.keys()), sum(agree), len(agree)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default="", help="recordings with this in their name")
    parser.add_argument("--in-front", type=float, nargs="+", default=[], metavar="SIZE")
    parser.add_argument("--picture", metavar="FILE")
    arguments = parser.parse_args()
    if not (arguments.picture or arguments.in_front):
        print(HEADER, flush=True)
    facts: list[Told] = []
    totals = np.zeros(4, int)
    for name, files in SETS.items():
        if arguments.only not in name:
            continue
        logs = [Log.read(folder() / file) for file in files]
        if arguments.picture:
            plots.save(plots.diagnosis_figure(diagnose(logs)), arguments.picture)
            return
        if arguments.in_front:
            for size in arguments.in_front:
                print(f"{name}, size {size:g}", flush=True)
                in_front(joined(logs), size)
            continue
        begun = time.process_time()
        budget = tried(logs)
        if isinstance(budget, str):
            print(f"| {name} | | | {budget} | | | |", flush=True)
            continue
        spent = time.process_time() - begun
        halves = [tried(half(logs, which)) for which in (0, 1)]
        alike = families_alike(*halves)
        totals += alike
        share = f"{budget.before:.2f} to {budget.left:.2f}"
        unexplained = f"{budget.unexplained.share.mean:.0%}"
        seconds = np.sum([log.seconds for log in logs])
        print(
            f"| {name} | {seconds:.0f} | {share} | {causes(budget)} | {unexplained} | "
            f"{' / '.join(map(said, halves))} | {alike[0]} of {alike[1]}, {alike[2]} of {alike[3]} | {spent:.0f} |",
            flush=True,
        )
        facts += told(name, budget)
    print(
        f"\nFamilies in both halves: {totals[0]} of {totals[1]}; sizes that agree: {totals[2]} of {totals[3]}",
        flush=True,
    )
    if facts:
        print("\n".join(["", FACTS_HEADER, *map(str, facts), "", closing(facts)]), flush=True)


if __name__ == "__main__":
    main()
