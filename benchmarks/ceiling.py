"""How much of what is missing the drives can show: the budget's selection beside one that was told the true causes.

``python -m benchmarks.ceiling --seed 20261125 --cases 40 --kept out/ceiling [--kind several] [--recorder ordinary]``

Draws cases of the blind test's reference vehicle, selects effects on their held-out blocks, and fits the true causes,
from their true onset on where they have one, to the same blocks. Of each true cause that a rollout can show it keeps
whether it was named, and how likely its own held-out evidence makes it once the others are in; of each case, whether
the held-out blocks prefer the true causes to those selected. A cause is likely here by the odds of one effect among all
that were tried, as it would be if the search came upon it. One line a case is kept in `--kept`; a second call goes on
where the first ended.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, get_args

from avtorch.blindtest import EFFECTS as TABLE
from avtorch.blindtest import draw_case
from avtorch.blindtest.cases import Recording
from avtorch.blindtest.intervals import wilson
from avtorch.gap import plant
from avtorch.gap.answer.budget import LIKELY
from avtorch.gap.budget.analysis_record import AnalysisRecord
from avtorch.gap.budget.entry import candidates_for, fitted, observable
from avtorch.gap.budget.forward_selection import select
from avtorch.gap.budget.likely_parts import likely_parts
from avtorch.gap.budget.onset_search import may_set_in
from avtorch.gap.budget.part_odds import PartOdds
from avtorch.gap.budget.redundancy import without_one
from avtorch.gap.budget.robust_fit import RobustFit
from avtorch.gap.budget.selection_step import Step, cost
from avtorch.gap.budget.share_order import own_response
from avtorch.gap.simulator.effect import EFFECTS, Effect
from avtorch.gap.simulator.effect_choice import chosen_effects

KINDS = ("single", "pair", "several")


def given(fitting: RobustFit, bare: Step, kinds: Sequence[type[Effect]], onset: float | None) -> Step:
    """All of `kinds` in, each time the one that fits best, as the selection fits an effect that it tries, or from the
    true `onset` on."""
    now, left = bare, list(kinds)
    while left:
        tried = [fitted(fitting, now, candidate) for candidate in candidates_for(fitting, now, left, None, "")]
        if onset is not None:
            late = [fit for fit in tried if may_set_in(fit.model, fit.model.names[-1])]
            models = [fit.model.setting_in(fit.model.names[-1], onset) for fit in late]
            tried += [fitting.fit(m, m.coordinates(fit.known)[None]) for m, fit in zip(models, late, strict=True)]
        best = min(tried, key=lambda fit: fit.nats)
        fit = fitting.fit(best.model, best.z[None])
        now = Step(fit, fitting.hold_out(fit), fit.model.names[-1])
        left = [kind for kind in left if kind.name != now.entered]
    return now


def case_figures(index: int, seed: int, kind: str, recorder: Recording) -> dict[str, Any]:
    """One drawn case, selected and told."""
    case = draw_case(index, seed, mix={kind: 1.0}, recorder=recorder)
    record = AnalysisRecord.for_budget([case.log()])
    selection = select(record, plant([]), chosen_effects(None))
    parts = likely_parts(selection).steps[1:]
    named = {name for part in parts for name in (str(part.entered), *part.aliases)}
    fitting = selection.fitting
    kinds = observable([EFFECTS[n] for n in case.names if n in EFFECTS], record)
    told = given(fitting, selection.steps[0], kinds, case.onset_s)
    causes = []
    for name in told.fit.model.names:
        evidence = without_one(fitting, told, name).evidence
        likely = PartOdds.read().probability(
            evidence, response=own_response(told, name), channels=record.channels, tried=selection.tried
        )
        causes.append({"name": name, "named": name in named, "probability": likely, "nats": evidence.nats})
    return {
        "case": index,
        "seed": seed,
        "kind": kind,
        "recorder": recorder,
        "tier": case.tier,
        "names": list(case.names),
        "selected": [str(part.entered) for part in parts],
        "wrong": [str(p.entered) for p in parts if not {str(p.entered), *p.aliases} & set(case.names)],
        "causes": causes,
        "nats_of_the_truth": cost(selection.last) - cost(told),
        "truth_preferred": fitting.preference(selection.last.held, told.held).strength() > 0,
        "selection_preferred": fitting.preference(told.held, selection.last.held).strength() > 0,
    }


def collect(folder: Path, seed: int, cases: int, kind: str, recorder: Recording) -> None:
    """Keep the figures of `cases` cases in `folder`; those that are there already are not drawn again."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{recorder}_{kind}_{seed}.jsonl"
    done = len(path.read_text(encoding="utf-8").splitlines()) if path.exists() else 0
    with path.open("a", encoding="utf-8") as lines:
        for index in range(done, cases):
            lines.write(json.dumps(case_figures(index, seed, kind, recorder)) + "\n")
            lines.flush()
            print(f"{recorder}, {kind}: case {index + 1} of {cases}", flush=True)


def row(cases: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Counts over cases: true causes that a rollout can show, named, likely once told; and what blocks prefer."""
    causes = [cause for case in cases for cause in case["causes"]]
    likely = [cause["probability"] >= LIKELY for cause in causes]
    named = [cause["named"] for cause in causes]
    return {
        "cases": len(cases),
        "causes": len(causes),
        "by_chance": sum(TABLE[n].by_chance for case in cases for n in case["names"] if n in TABLE),
        "named": sum(named),
        "likely_once_told": sum(likely),
        "of_these_named": sum(n and p for n, p in zip(named, likely, strict=True)),
        "wrong_names": sum(len(case["wrong"]) for case in cases),
        "blocks_prefer_the_truth": sum(case["truth_preferred"] for case in cases),
        "blocks_prefer_the_selection": sum(case["selection_preferred"] for case in cases),
    }


def share(hits: int, of: int) -> str:
    """A share with its 90 % interval."""
    interval = wilson(hits, of)
    return f"{hits} of {of}" + ("" if interval is None else f" ({100 * interval[0]:.0f} to {100 * interval[1]:.0f} %)")


def main() -> None:
    """Collect, and print a table of all that is kept."""
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("--cases", type=int, required=True)
    parser.add_argument("--kept", type=Path, required=True)
    parser.add_argument("--kind", choices=KINDS, default="several")
    parser.add_argument("--recorder", choices=get_args(Recording), default="ordinary")
    args = parser.parse_args()
    collect(args.kept, args.seed, args.cases, args.kind, args.recorder)
    lines = [x for path in sorted(args.kept.glob("*.jsonl")) for x in path.read_text(encoding="utf-8").splitlines()]
    cases = [json.loads(line) for line in lines]
    for recorder, kind in sorted({(case["recorder"], case["kind"]) for case in cases}):
        found = row([case for case in cases if (case["recorder"], case["kind"]) == (recorder, kind)])
        print(f"{recorder}, {kind}: {found['cases']} cases, {found['by_chance']} causes besides that act by chance")
        print(f"  named: {share(found['named'], found['causes'])}, and {found['wrong_names']} wrong names")
        print(f"  likely once the causes are told: {share(found['likely_once_told'], found['causes'])}")
        print(f"  of these named: {share(found['of_these_named'], found['likely_once_told'])}")
        preferred = found["blocks_prefer_the_truth"], found["blocks_prefer_the_selection"]
        print(f"  held-out blocks prefer the true causes in {preferred[0]} cases, those selected in {preferred[1]}")


if __name__ == "__main__":
    main()
