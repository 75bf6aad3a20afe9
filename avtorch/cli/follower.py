"""`avtorch diagnose --follower`: a car that follows, without what its controller demanded."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.markup import escape
from rich.table import Table

from avtorch.cli.diagnosis_table import diagnosis_headline, diagnosis_notes
from avtorch.cli.pedals import FILES as PEDAL_FILES
from avtorch.cli.talk import Talk
from avtorch.errors import InputError

if TYPE_CHECKING:
    from avtorch.report import Origin


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
) -> None:
    """Diagnose the follower, write the answer and the page, and print a summary.

    `source`: keywords of `read_following`.
    """
    from avtorch.follower import diagnose_follower
    from avtorch.follower.words import loop_lines
    from avtorch.gap.result.diagnosis import DIAGNOSIS_FILES
    from avtorch.io import answer_set, check, read_following, write_json
    from avtorch.remedy import write_exports
    from avtorch.report import write_report

    log = read_following(path, **source)
    noted = [*check(log).notes, *log.remarks]
    talk.notes(log.name, noted)
    found = diagnose_follower(log, law=law, effects=effects, seed=seed, progress=step)
    gap = found.diagnosis
    assert gap is not None
    gap = replace(gap, notes=(*gap.notes, *found.conditional))
    lines = loop_lines(found)
    answer = replace(found, diagnosis=gap).to_dict()
    with answer_set(out, (*DIAGNOSIS_FILES, *PEDAL_FILES)) as staged:
        written = [*gap.write(staged), *write_exports(gap.plant, staged)]
        write_json(staged / "diagnosis.json", answer)
        written.append(write_report(gap, staged, quality=noted, sections={"The loop": lines}, origin=origin))
    if talk.json:
        talk.done(out, answer)
        return
    for line in lines:
        talk.out.print(escape(line))
    talk.out.print()
    talk.out.print(_table(found.parameters))
    talk.out.print("\nConditional on that law, on the held-out half of the drive:")
    talk.out.print(*diagnosis_headline(gap), sep="\n")
    for note in diagnosis_notes(gap):
        talk.out.print(note)
    names = ", ".join(p.name for p in written)
    talk.out.print(f"\nWritten to [bold]{escape(str(out))}[/bold]: {names}", soft_wrap=True)


def _table(parameters: Mapping[str, Any]) -> Table:
    from avtorch.gap.quantity import unit_of, words_of

    table = Table(box=None, header_style="bold", pad_edge=False, padding=(0, 2, 0, 0))
    for title in ("of the loop", "mean", "90 %"):
        table.add_column(title, no_wrap=True)
    for name, q in parameters.items():
        unit = unit_of(name)
        table.add_row(words_of(name), f"{q.mean:.2f}{'' if unit == '-' else ' ' + unit}", f"{q.q05:.2f} to {q.q95:.2f}")
    return table
