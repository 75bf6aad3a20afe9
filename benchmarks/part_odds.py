"""Fit the odds of the budget's parts to simulated cases, and write them with their provenance.

``python -m benchmarks.part_odds --seed 20261125 --cases 240 --kept out/part_odds [--recorder ideal] [--signals speed]
[--outside] [--background LOG]``

Draws cases of the blind test's reference vehicle (with `--outside`: cases whose cause is outside the table, of the
families that may serve to calibrate; they should be about one in seven of all, as in the blind test), selects effects
on their held-out blocks, and keeps the figures of each part of the gap in `--kept`, one line a case (some ten seconds
of processor time); a second call goes on where the first ended. It prints how the odds do on cases that were left out,
beside Student's law alone. `--write` fits them to all drawn cases in `--kept`, of both recorders, and writes
`avtorch/gap/budget/part_odds.json`. Causes outside the table serve for what an answer without a likely part, or with a
wrong one, leaves open; learnt from as parts that are not there they made every name less likely, and on the Genesis'
laps nothing was named. With `--background` the cases are effects put in front of a recording in place of drawn ones;
parts that the untouched recording has, too, are neither right nor wrong. The odds are fitted to drawn cases alone, and
those of recordings show how they do there; fitted to these as well they did no better on other recordings. The drives
that the odds in use are fitted to are in `benchmarks/part_odds_cases`; the recordings among them are none of those in
front of which the budget is scored.
"""

from __future__ import annotations

import argparse
import json
import subprocess
from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from datetime import date
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any, get_args

import numpy as np
from scipy.optimize import minimize
from scipy.special import log_expit, ndtr

from avtorch.arrays import BoolArray, FloatArray, IntArray
from avtorch.blindtest import IN_FRONT, draw_case, put_in_front
from avtorch.blindtest.cases import SIGNALS, Recording
from avtorch.errors import InputError
from avtorch.gap import EFFECTS, plant
from avtorch.gap.answer.budget import LIKELY
from avtorch.gap.budget.analysis_record import AnalysisRecord
from avtorch.gap.budget.forward_selection import baseline_noise, select
from avtorch.gap.budget.held_out_evidence import Evidence
from avtorch.gap.budget.part_odds import PATH, SCHEMA, PartOdds, by_agreement, figures
from avtorch.gap.budget.redundancy import without_one
from avtorch.gap.budget.rollout_energy import relative_energy
from avtorch.gap.budget.selection_step import Selection, complexity
from avtorch.gap.budget.share_order import energies, largest_first, own_response
from avtorch.gap.simulator.effect_choice import chosen_effects
from avtorch.io import Log, write_json

MIX = {"none": 0.3, "single": 0.4, "pair": 0.2, "several": 0.1}
OUTSIDE = {"outside": 1.0}
_RIDGE = 0.5  # of the weights but the constant, as two parts would have it
_FOLDS = 10
_DIGITS = 3
_SIZES = (1.0, 0.7)  # of effects in front of a recording, one round each; scored are others
_SIMULATED, _IN_FRONT = "simulated", "in front of recordings"


def case_figures(
    index: int, seed: int, recorder: Recording, signals: Sequence[str], mix: Mapping[str, float]
) -> dict[str, Any]:
    """The parts that are selected on one drawn case, with their evidence, and whether each is there."""
    case = draw_case(index, seed, mix=mix, outside="calibration", recorder=recorder, signals=signals)
    record = AnalysisRecord.for_budget([case.log(signals=signals)])
    selection = largest_first(select(record, plant([]), chosen_effects(None)))
    return {
        "case": index,
        "seed": seed,
        "recorder": recorder,
        "signals": list(signals),
        "mix": dict(mix),
        "kind": case.kind,
        "tier": case.tier,
        "names": list(case.names),
        "blocks": record.blocks,
        **selected_figures(selection, case.names),
    }


def figures_in_front(log: Log, background: str, index: int, seed: int, own: Collection[str]) -> dict[str, Any]:
    """The same of effect number `index` of those that no chance decides, in front of a recording, which has its `own`.

    The next round through them is of another size.
    """
    effects = [name for name in IN_FRONT if not EFFECTS[name].random]
    effect, size = effects[index % len(effects)], _SIZES[index // len(effects) % len(_SIZES)]
    bare = baseline_noise(AnalysisRecord.for_budget([log]), plant([]))[1]
    T_L, K_L = (float(bare.model.values(bare.z)[key]) for key in ("T_L", "K_L"))
    case = {"case": index, "seed": seed, "recorder": "recording", "background": background, "kind": "in_front"}
    case |= {"mix": {}, "names": [effect], "size": size}
    try:
        changed, _ = put_in_front(log, effect, T_L=T_L, K_L=K_L, size=size, seed=seed + index)
        record = AnalysisRecord.for_budget([changed])
    except InputError as refusal:  # an effect of a sensor that it lacks
        return case | {"signals": [], "tried": 0, "gap": 0.0, "parts": [], "refused": str(refusal)}
    selection = largest_first(select(record, plant([]), chosen_effects(None)))
    return case | {
        "signals": sorted(record.channels),
        "blocks": record.blocks,
        **selected_figures(selection, [effect], own),
    }


def selected_names(log: Log) -> set[str]:
    """What is selected on a recording as it is, with aliases."""
    steps = select(AnalysisRecord.for_budget([log]), plant([]), chosen_effects(None)).steps[1:]
    return {name for step in steps for name in (str(step.entered), *step.aliases)}


def selected_figures(selection: Selection, names: Collection[str], own: Collection[str] = ()) -> dict[str, Any]:
    """The figures of a selection's parts, of which the true ones are `names`; of those in `own` nobody knows."""
    return {
        "tried": selection.tried,
        "gap": float(energies(selection, 0)[-1][0, 0]) - 1.0,
        "parts": [
            {
                "name": step.entered,
                "there": bool({step.entered, *step.aliases} & set(names)),
                "own": step.entered in own and step.entered not in names,
                "nats": step.evidence.nats,
                "errors": step.evidence.errors,
                "freedom": step.evidence.freedom,
                "parameters": complexity(step.fit) - complexity(before.fit),
                "response": own_response(selection.last, str(step.entered)),
                "at_limit": selection.last.fit.model.at_limit(selection.last.fit.z, str(step.entered)),
                # the odds do without these two: they tell no more than the others
                "share": taken(selection, str(step.entered)),
                "onset": step.entered in selection.last.fit.model.onsets,
            }
            for before, step in pairwise(selection.steps)
        ],
    }


def taken(selection: Selection, name: str) -> float:
    """What an effect takes off the errors of held-out rollouts beside the others, in units of the bare baseline's."""
    without = without_one(selection.fitting, selection.last, name)
    return relative_energy(selection, without) - relative_energy(selection, selection.last)


def collect(
    folder: Path, seed: int, cases: int, recorder: Recording, signals: Sequence[str], mix: Mapping[str, float]
) -> None:
    """Keep the figures of `cases` cases in `folder`; those that are there already are not drawn again."""
    which = "outside_" if mix is OUTSIDE else ""
    path = folder / f"{recorder}_{'_'.join(signals)}_{which}{seed}.jsonl"
    _kept_in(path, cases, lambda index: case_figures(index, seed, recorder, signals, mix))


def collect_in_front(folder: Path, seed: int, cases: int, recording: Path) -> None:
    """The same of effects in front of a recording."""
    log = Log.read(recording)
    own = cache(lambda: selected_names(log))  # not where all cases are kept already
    path = folder / f"recording_{recording.stem}_{seed}.jsonl"
    background = f"{recording.resolve().parent.name}/{recording.name}"  # no path of the machine
    _kept_in(path, cases, lambda index: figures_in_front(log, background, index, seed, own()))


def _kept_in(path: Path, cases: int, figures_of: Callable[[int], dict[str, Any]]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    done = len(path.read_text(encoding="utf-8").splitlines()) if path.exists() else 0
    with path.open("a", encoding="utf-8") as lines:
        for index in range(done, cases):
            lines.write(json.dumps(figures_of(index)) + "\n")
            lines.flush()
            print(f"{path.stem}: case {index + 1} of {cases}", flush=True)


def kept(folder: Path) -> list[dict[str, Any]]:
    """All cases in `folder`."""
    paths = sorted(folder.glob("*.jsonl"))
    return [json.loads(line) for path in paths for line in path.read_text(encoding="utf-8").splitlines()]


def table(
    cases: Sequence[dict[str, Any]],
) -> tuple[FloatArray, FloatArray, BoolArray, IntArray, FloatArray, FloatArray]:
    """Of all parts: figures (part, 5), log effects tried, whether there, its case, `by_agreement`, Student's law."""
    rows, tried, there, of, agreed, strict = [], [], [], [], [], []
    for number, case in enumerate(cases):
        for part in case["parts"]:
            if part.get("at_limit", False) or part.get("own", False):  # no part of an answer, or nobody knows
                continue
            evidence = Evidence(part["nats"], part["errors"], part["freedom"])
            rows.append(figures(evidence, part["response"], case["signals"]))
            there.append(part["there"])
            of.append(number)
            tried.append(np.log(case["tried"]))
            agreed.append(by_agreement(evidence, case["tried"]))
            strict.append(ndtr(evidence.strength(case["tried"])))
    return np.array(rows), np.array(tried), np.array(there), np.array(of), np.array(agreed), np.array(strict)


def fit(
    rows: FloatArray, tried: FloatArray, there: BoolArray, *, of_cases: Sequence[float] = (0.5, 0, 0.5, 0)
) -> PartOdds:
    """The weights that make `there` likeliest; more evidence is never less, nor is a speed that is recorded.

    `of_cases`: what `none_and_outside` says of cases without a likely part, and of those with a wrong one.
    """
    sign = np.where(there, 1.0, -1.0)

    def cost(w: FloatArray) -> float:
        return float(-log_expit(sign * (rows @ w - tried)).sum() + 0.5 * _RIDGE * (w[1:] ** 2).sum())

    bounds = [(None, None), *[(0.0, None)] * (rows.shape[1] - 2), (None, 0.0)]
    best = minimize(cost, np.zeros(rows.shape[1]), method="L-BFGS-B", bounds=bounds).x
    return PartOdds(*(float(f"{w:.{_DIGITS}g}") for w in [*best, *of_cases]))


def left_out(rows: FloatArray, tried: FloatArray, there: BoolArray, of: IntArray, agreed: FloatArray) -> FloatArray:
    """Each part's probability, by a fit to the other cases; none above what is `agreed` on (`by_agreement`)."""
    fold = np.random.default_rng(0).integers(0, _FOLDS, of.max() + 1)[of]
    probability = np.zeros(len(rows))
    for k in range(_FOLDS):
        odds, own = fit(rows[fold != k], tried[fold != k], there[fold != k]), fold == k
        probability[own] = np.exp(log_expit(rows[own] @ odds.weights - tried[own]))
    return np.minimum(probability, agreed)


def verdicts(
    probability: FloatArray, there: BoolArray, of: IntArray, cases: Sequence[dict[str, Any]]
) -> tuple[list[str], list[str]]:
    """Kinds of the cases without a likely part, and of those with one that is not there."""
    named = probability >= LIKELY
    unnamed, wrong = set(range(len(cases))) - set(of[named].tolist()), set(of[named & ~there].tolist())
    return [cases[number]["kind"] for number in unnamed], [cases[number]["kind"] for number in wrong]


def none_and_outside(kinds: Sequence[str]) -> tuple[float, float]:
    """Of cases of these `kinds` the share that has no cause, and the share that has one outside the table."""
    count = Counter(kinds)
    return (count["none"] + 0.5) / (len(kinds) + 1.5), (count["outside"] + 0.5) / (len(kinds) + 1.5)


def scores(probability: FloatArray, there: BoolArray, of: IntArray, cases: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Log loss and calibration error of probabilities, and what is named with them."""
    p = np.clip(probability, 0.005, 0.995)  # as few cases would allow
    tenth = np.minimum((10 * p).astype(int), 9)
    error = sum(abs(p[tenth == k].mean() - there[tenth == k].mean()) * (tenth == k).mean() for k in set(tenth))
    named = p >= 0.5
    none = [number for number, case in enumerate(cases) if case["kind"] == "none"]
    return {
        "log_loss": round(float(-np.where(there, np.log(p), np.log(1 - p)).mean()), 3),
        "calibration_error": round(float(error), 3),
        "named": int(named.sum()),
        "of_them_there": round(float(there[named].mean()), 3),
        "there_and_named": round(float(there[named].sum() / there.sum()), 3),
        "without_a_cause": len(none),
        "of_them_accused": len(set(of[named].tolist()) & set(none)),
    }


def _print_scores(title: str, by_odds: Mapping[str, Any], by_law: Mapping[str, Any]) -> None:
    print(title)
    for key in by_odds:
        print(f"{key:20} {by_odds[key]:8} by the odds (cases left out) {by_law[key]:8} by Student's law")


def main() -> None:
    """Collect, print, and write where asked to."""
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("--cases", type=int, required=True)
    parser.add_argument("--kept", type=Path, required=True)
    parser.add_argument("--recorder", choices=get_args(Recording), default="ordinary")
    parser.add_argument("--signals", nargs="+", choices=SIGNALS, default=SIGNALS)
    parser.add_argument("--outside", action="store_true", help="causes outside the table")
    parser.add_argument("--background", type=Path, metavar="LOG", help="a recording to put effects in front of")
    parser.add_argument("--write", action="store_true")
    args = parser.parse_args()
    if args.background is None:
        collect(args.kept, args.seed, args.cases, args.recorder, args.signals, OUTSIDE if args.outside else MIX)
    else:
        collect_in_front(args.kept, args.seed, args.cases, args.background)
    every = kept(args.kept)
    cases = [case for case in every if case["kind"] != "outside"]
    rows, tried, there, of, agreed, strict = table(cases)
    drawn = np.array([case["kind"] != "in_front" for case in cases])[of]
    odds = fit(rows[drawn], tried[drawn], there[drawn])
    probability = np.minimum(np.exp(log_expit(rows @ odds.weights - tried)), agreed)
    probability[drawn] = left_out(rows[drawn], tried[drawn], there[drawn], of[drawn], agreed[drawn])
    scored = {}
    for world, own in ((_SIMULATED, drawn), (_IN_FRONT, ~drawn)):
        if own.any():
            scored[world] = [scores(p[own], there[own], of[own], cases) for p in (probability, strict)]
            _print_scores(f"{world}: {own.sum()} parts of {len(set(of[own]))} cases with any", *scored[world])
    if _SIMULATED not in scored:
        print("no drawn cases with a part in --kept, which odds need")
        return
    by_odds, by_law = scored[_SIMULATED]
    simulated = [case for case in cases if case["kind"] != "in_front"]
    number = {id(case): n for n, case in enumerate(simulated)}
    unnamed, wrong = verdicts(
        probability[drawn], there[drawn], np.array([number[id(cases[n])] for n in of[drawn]]), simulated
    )
    outside = [case for case in every if case["kind"] == "outside"]
    if outside and any(not part.get("at_limit", False) for case in outside for part in case["parts"]):
        others, others_tried, _, others_of, others_agreed, _ = table(outside)
        blamed = np.minimum(np.exp(log_expit(others @ odds.weights - others_tried)), others_agreed)
        more = verdicts(blamed, np.zeros(len(others), dtype=bool), others_of, outside)
        unnamed, wrong = unnamed + more[0], wrong + more[1]
    of_cases = [*none_and_outside(unnamed), *none_and_outside(wrong)]
    print(f"{len(unnamed)} cases without a likely part: none {of_cases[0]:.2f}, outside the table {of_cases[1]:.2f}")
    print(f"{len(wrong)} with a likely part that is wrong: none {of_cases[2]:.2f}, outside the table {of_cases[3]:.2f}")
    if args.write:
        odds, cases = fit(rows[drawn], tried[drawn], there[drawn], of_cases=of_cases), every
        counts = Counter(
            (c["recorder"], " ".join(c["signals"]), c["seed"], json.dumps(c["mix"]), c.get("background", ""))
            for c in cases
        )
        commit = subprocess.run(["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=True)
        provenance = {
            "made_by": "python -m benchmarks.part_odds --write",
            "cases": [
                {"recorder": r, "signals": w, "seed": s, "cases": n, "mix": json.loads(mix)}
                | ({"background": log} if log else {})
                for (r, w, s, mix, log), n in sorted(counts.items())
            ],
            "parts": int(drawn.sum()),
            "date": date.today().isoformat(),
            "commit": commit.stdout.strip(),
            "left_out": by_odds,
            "students_law": by_law,
            **({"left_out_in_front": scored[_IN_FRONT][0]} if _IN_FRONT in scored else {}),
        }
        write_json(PATH, {"schema": SCHEMA, "constants": vars(odds), "provenance": provenance})


if __name__ == "__main__":
    main()
