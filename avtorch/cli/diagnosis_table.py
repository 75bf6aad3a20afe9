"""A diagnosis to read in ten seconds: one sentence, one table, a few lines below it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from math import floor, log10
from typing import TYPE_CHECKING

from rich.markup import escape
from rich.table import Table

if TYPE_CHECKING:
    from avtorch.gap.answer.budget import Budget
    from avtorch.gap.result.diagnosis import Candidate, Diagnosis, Quantity

ROWS = 8
BAR = 8
_FAINT = 0.01  # candidates less probable than this are only counted
_WIDE = 30  # cells that a terminal of 80 leaves for parameters
_EIGHTHS = " ▏▎▍▌▋▊▉█"


def diagnosis_headline(found: Diagnosis) -> list[str]:
    """The verdict in one sentence, its budget, its implausible parameters, and the diagnosis' reason below."""
    from avtorch.gap.result.sentences import budget, headline, tested

    odd = found.winner.implausible
    style = (
        "bold yellow" if odd else {"unknown": "bold yellow", "none": "bold green"}.get(found.verdict.name, "bold cyan")
    )
    lines = [f"[{style}]{escape(headline(found))}[/]", *(f"[yellow]{escape(line)}[/]" for line in odd)]
    return [*lines, *map(escape, tested(found)), *map(escape, budget(found)), f"[dim]{escape(found.verdict.why)}[/]"]


def budget_table(budget: Budget, epoch_s: float = 0.0) -> Table:
    """One row per part of the gap, what chance decides, and what is unexplained; times count from `epoch_s`."""
    from avtorch.gap.answer.budget import percent
    from avtorch.gap.result.sentences import number

    table = Table(box=None, header_style="bold", pad_edge=False, padding=(0, 2, 0, 0))
    table.add_column("of the gap", no_wrap=True)
    table.add_column("share", no_wrap=True)
    table.add_column("probability", no_wrap=True)
    table.add_column("parameters (90 %)")

    def words(parameters: Mapping[str, Quantity], plausible: bool) -> str:
        lines = [_parameter(key, parameters, q) for key, q in parameters.items()]
        return "\n".join([*lines, *([] if plausible else ["physically implausible"])])

    for part in budget.parts:
        share = f"{percent(part.share.mean):>10} {bar(part.share.mean)}"
        parameters = words(part.parameters, part.plausible)
        table.add_row(escape(part.name), share, number(part.probability), parameters, style="bold")
    for part in budget.chance:
        parameters = words(part.parameters or {}, part.plausible)
        table.add_row(escape(part.name), "     noise", number(part.probability), parameters, style="bold")
    rest = budget.unexplained
    style = "yellow" if rest.material else "dim"
    table.add_row(
        "unexplained", f"{percent(rest.share.mean):>10} {bar(rest.share.mean)}", "", rest.places(epoch_s), style=style
    )
    return table


def diagnosis_table(found: Diagnosis) -> Table:
    """One row per candidate: probability, log evidence, parameters."""
    from avtorch.gap.result.sentences import number

    table = Table(box=None, header_style="bold", pad_edge=False, padding=(0, 2, 0, 0))
    table.add_column("hypothesis", no_wrap=True)
    table.add_column("probability", no_wrap=True)
    table.add_column("nats", justify="right", no_wrap=True)
    table.add_column("parameters (90 %)")
    printed, left = _printed(found.candidates)
    for c in printed:
        first = c.name == found.verdict.name
        style = "bold" if first else None if c.name in found.verdict.alias_set else "dim"
        gain = round(c.log_evidence or 0.0)
        nats = "" if c.log_evidence is None else f"{gain:+d}" if gain else "0"
        several = len(c.effects) > 2
        lines = [] if several else [_parameter(name, c.parameters, q) for name, q in c.parameters.items()]
        lines += ["physically implausible"] if c.implausible and c.name != "unknown" else []
        name = f"these {len(c.effects)} effects" if several else c.name.replace("+", " +\n")
        table.add_row(
            escape(name), f"{number(c.probability)} {bar(c.probability)}", nats, "\n".join(lines), style=style
        )
    if left:
        rest = sum(c.probability for c in left)
        table.add_row(f"{len(left)} {'others' if len(left) > 1 else 'other'}", number(rest), "", "", style="dim")
    return table


def diagnosis_notes(found: Diagnosis) -> list[str]:
    """Further lines with markup: alias set, onset, size of the gap, what remains, budget."""
    from avtorch.gap.result import sentences

    plain = [
        sentences.aliases(found),
        *sentences.onset(found),
        *sentences.where(found),
        *sentences.moved(found),
        *sentences.gap(found),
    ]
    plain += [
        *sentences.shrinkage(found),
        *sentences.to_set(found),
        *sentences.to_drive(found),
        *sentences.remains(found),
    ]
    lines = [escape(line) for line in plain]
    if not found.complete:
        text = "The budget ended the search: the answer is provisional; give the command a larger one."
        lines.append(f"[yellow]{text}[/]")
    return lines + [f"[dim]{escape(note)}[/]" for note in found.notes if found.complete or "budget" not in note]


def bar(share: float) -> str:
    """`share` of `BAR` cells, in eighths of a cell."""
    eighths = round(8 * BAR * min(max(share, 0.0), 1.0))
    full, part = divmod(eighths, 8)
    return ("█" * full + (_EIGHTHS[part] if part else "")).ljust(BAR)


def _printed(candidates: Iterable[Candidate]) -> tuple[list[Candidate], list[Candidate]]:
    """Rows to print, and rows left out. The rows of the verdict, `none` and `unknown` are always printed."""
    ranked = list(candidates)
    always = [c for c in ranked if c.name in ("none", "unknown")]
    best = [c for c in ranked if c not in always and (c is ranked[0] or c.probability >= _FAINT)]
    best = best[: ROWS - len(always)]
    printed = [c for c in ranked if c in best or c in always]
    return printed, [c for c in ranked if c not in printed]


def _parameter(key: str, parameters: Mapping[str, Quantity], q: Quantity) -> str:
    from avtorch.gap.quantity import unit_of, words_of

    effect, _, own = key.rpartition(".")
    # a pair's parameters need the effect's name only where both have one of that name
    twice = sum(k.rpartition(".")[2] == own for k in parameters) > 1
    unit = unit_of(own)
    words = f"{effect}: {words_of(own)}" if twice else words_of(own)
    mean, interval = _interval(q, "" if unit == "-" else " " + unit)
    between = " " if len(words) + len(mean) + len(interval) + 2 <= _WIDE else "\n  "
    return escape(f"{words} {mean}{between}{interval}")


def _interval(q: Quantity, unit: str) -> tuple[str, str]:
    """Mean and 90 %, to the digit that the interval supports."""
    width = q.q95 - q.q05
    digits = min(max(1 - floor(log10(width)), 0), 7) if width > 0 else 3
    return f"{q.mean:.{digits}f}{unit}", f"({q.q05:.{digits}f} to {q.q95:.{digits}f})"
