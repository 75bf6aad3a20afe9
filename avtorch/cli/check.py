"""`avtorch check`: what a log is and how to read it, before anything is estimated from it."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from avtorch.cli import arguments as arg
from avtorch.cli.talk import Talk
from avtorch.errors import InputError

if TYPE_CHECKING:
    from avtorch.logcheck.check import LogCheck


def check(
    log: Path,
    *,
    map: arg.Columns = None,
    unit: arg.Units = None,
    yes: Annotated[bool, arg.option("Write the proposed mapping unasked.", arg.OUTPUT, name=("--yes", "-y"))] = False,
    json: arg.Json = False,
    quiet: arg.Quiet = False,
) -> None:
    """Check a log: what it holds, how to read it, what it can tell and what not.

    Names and units of its columns are found from their headers and from the data, each with its reason, and proposed as
    a mapping: LOG.toml beside the log, which every other command then reads. What is in doubt is asked: answer with
    --map and --unit, which become part of it.

    Parameters
    ----------
    log
        A table of text in any layout, gzipped or not, or Parquet.
    """
    from avtorch.io.answers import atomic
    from avtorch.io.mapping import mapping_beside, mapping_place
    from avtorch.logcheck.check import check as work

    talk = Talk(json=json, quiet=quiet)
    found = work(log, map=map, unit=unit)
    proposal, beside = found.proposal, mapping_place(log)
    _print(talk, found)
    if json and not quiet:
        talk.answer(found.to_dict())
    if found.follows:
        talk.line(f"Cars that follow, without commands. Next: avtorch diagnose {log} --follower")
    elif proposal is None:
        talk.line(f"Read as {mapping_beside(log)} says.")
    elif proposal.needed:
        if found.fault is not None:
            talk.line(f"Nothing was written: as proposed the log cannot be read yet; {beside} may name what is missing")
        elif yes or _agreed(talk, beside):
            with atomic(beside) as file:
                file.write(proposal.toml(log.name))
            talk.line(f"Written to {beside}. Next: avtorch estimate {log}, or avtorch diagnose {log}")
        else:
            talk.line(f"Nothing was written; avtorch check {log} --yes writes it to {beside}")
    elif found.fault is None:
        talk.line(f"It needs no mapping. Next: avtorch estimate {log}, or avtorch diagnose {log}")
    if found.fault is not None:
        raise InputError(found.fault)


def _print(talk: Talk, found: LogCheck) -> None:
    """What a log is, how to read it, and what was seen in it."""
    from avtorch.report.table import Table

    talk.line(found.source, "bold")
    talk.lines([f"  {found.form}", ""])
    proposal = found.proposal
    if proposal is not None and proposal.signals:
        rows = [(signal, one.column, one.unit or "", one.reason) for signal, one in proposal.signals.items()]
        talk.table(Table("The mapping", ("signal", "column", "unit", "why"), tuple(rows)))
    if proposal is not None:
        talk.lines([f"In doubt: {doubt}" for doubt in proposal.doubts], "yellow")
    seen = () if found.quality is None else found.quality.notes
    for title, notes in (("Seen", seen), ("Recorder", found.recorder), ("Excitation", found.excitation)):
        if notes:
            talk.notes(title, notes)


def _agreed(talk: Talk, beside: Path) -> bool:
    """Whether the user takes the proposal, by one key; unasked where nobody sits at the terminal."""
    if talk.silent or not (sys.stdin.isatty() and sys.stdout.isatty()):
        return False
    try:
        return input(f"Write this to {beside}? [Y/n] ").strip().lower() in ("", "y", "yes")
    except EOFError:
        return False
