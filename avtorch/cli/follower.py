"""`avtorch diagnose --follower`: a car that follows, without what its controller demanded."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from avtorch.cli.pedals import FILES as PEDAL_FILES
from avtorch.cli.talk import Talk
from avtorch.errors import InputError

if TYPE_CHECKING:
    from avtorch.gap.result.diagnosis import Diagnosis
    from avtorch.report import Origin
    from avtorch.report.table import Table


def refuse(logs: Sequence[Path], **given: object) -> None:
    """Raise `InputError` for what has no meaning for a follower: more logs, an option `given`."""
    if len(logs) > 1:
        raise InputError(f"--follower: found {len(logs)} logs, needs one at a time")
    for option, value in given.items():
        if value:
            raise InputError(f"--{option.replace('_', '-')}: has no meaning with --follower")


def follow(
    talk: Talk,
    path: Path,
    out: Path,
    *,
    source: Mapping[str, Any],
    law: str | None,
    effects: Sequence[str] | None,
    seed: int,
    step: Callable[[str, int, int], None],
    origin: Origin,
    verbose: bool,
) -> None:
    """Diagnose the follower, write the answer and the page, and print a summary.

    `source`: keywords of `read_following`.
    """
    from avtorch.follower import diagnose_follower
    from avtorch.gap.result.diagnosis import DIAGNOSIS_FILES
    from avtorch.io import answer_set, check, read_following, write_json
    from avtorch.remedy import write_exports
    from avtorch.report import write_report

    log = read_following(path, **source)
    noted = [*check(log).notes, *log.remarks]
    if verbose:
        talk.notes(log.name, noted)
    found = diagnose_follower(log, law=law, effects=effects, seed=seed, progress=step)
    gap = found.diagnosis
    assert gap is not None
    gap = replace(gap, notes=(*gap.notes, *found.conditional))
    lines = found.sentences()
    answer = replace(found, diagnosis=gap).to_dict()
    with answer_set(out, (*DIAGNOSIS_FILES, *PEDAL_FILES)) as staged:
        written = [*gap.write(staged), *write_exports(gap.plant, staged)]
        write_json(staged / "diagnosis.json", answer)
        written.append(write_report(gap, staged, quality=noted, sections={"The loop": lines}, origin=origin))
    if not talk.json:
        talk.lines(lines)
        talk.line("")
        talk.table(_table(found.parameters))
        talk.line("Conditional on that law, on the held-out half of the drive:")
        print_diagnosis(talk, gap, verbose=verbose)
    talk.done(out, answer, files=[p.name for p in written])


def _table(parameters: Mapping[str, Any]) -> Table:
    from avtorch.gap.quantity import unit_of, words_of
    from avtorch.report.table import Table

    units = {name: "" if unit_of(name) == "-" else f" {unit_of(name)}" for name in parameters}
    rows = tuple(
        (words_of(name), f"{q.mean:.2f}{units[name]}", f"{q.q05:.2f} to {q.q95:.2f}") for name, q in parameters.items()
    )
    return Table("The loop", ("of the loop", "mean", "90 %"), rows)


def print_diagnosis(talk: Talk, found: Diagnosis, *, verbose: bool = False) -> None:
    """The verdict in one sentence and one table; the page's other sentences and tables where `verbose`."""
    from avtorch.gap.result import sentences
    from avtorch.report.diagnosis_tables import budget_table, candidate_table

    odd = found.winner.implausible
    known = {"unknown": "bold yellow", "none": "bold green"}
    talk.lines([sentences.headline(found)], "bold yellow" if odd else known.get(found.verdict.name, "bold cyan"))
    talk.lines(odd, "yellow")
    if not found.complete:
        text = "The budget ended the search: the answer is provisional; give the command a larger one."
        talk.lines([text], "yellow")
    if verbose:
        talk.lines([*sentences.tested(found), *sentences.budget(found)])
    elif found.budget is not None and found.budget.rest:
        talk.lines([found.budget.rest])
    if verbose:
        talk.lines([found.verdict.why], "dim")
    talk.line("")
    budget = found.budget
    divided = budget is not None and (budget.parts or budget.chance or budget.unexplained.material)
    if budget is not None and divided:
        talk.table(budget_table(budget, found.log.epochs_s[0]))
    if verbose or not divided:
        talk.table(candidate_table(found, most=8 if verbose else 5))
    if verbose:
        talk.lines([sentences.aliases(found), *sentences.onset(found), *sentences.where(found)])
        talk.lines([*sentences.moved(found), *sentences.gap(found), *sentences.shrinkage(found)])
        talk.lines([*sentences.to_set(found), *sentences.to_drive(found), *sentences.remains(found)])
        talk.lines([note for note in found.notes if found.complete or "budget" not in note], "dim")
        talk.line("")
