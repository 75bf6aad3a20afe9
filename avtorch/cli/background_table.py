"""The table of effects in front of recordings: by effect and size, and over all with 90 % intervals."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rich.markup import escape
from rich.table import Table

# the counts, and out of how many
_COUNTS = (
    ("held", "trials"),
    ("size_right", "sized"),
    ("covered", "bounded"),
    ("extra", "trials"),
    ("nothing_named", "trials"),
)
_HEADS = ("named", "size right", "covered", "extra", "nothing")  # short, so that the effects' names fit beside them


def background_table(answer: Mapping[str, Any]) -> Table:
    """A row per effect and size, then the totals; `answer` as of `avtorch.trial.run_background`."""
    table = Table(box=None, header_style="bold", pad_edge=False, padding=(0, 2, 0, 0))
    table.add_column("", no_wrap=True)
    for head in ("size", *_HEADS):
        table.add_column(head, justify="right", no_wrap=True)
    for cell in answer["table"]:
        table.add_row(escape(cell["effect"]), f"{cell['size']:g}", *(f"{cell[key]}/{cell[of]}" for key, of in _COUNTS))
    for cell in answer["by_size"]:
        table.add_row("all", f"{cell['size']:g}", *(f"{cell[key]}/{cell[of]}" for key, of in _COUNTS), style="bold")
    totals = answer["totals"]
    table.add_row("all", "", *(f"{totals[key]}/{totals[of]}" for key, of in _COUNTS), style="bold")
    table.add_row("", "90 %", *(_interval(totals["intervals"][key]) for key, _ in _COUNTS), style="dim")
    return table


def background_notes(answer: Mapping[str, Any]) -> list[str]:
    """What the columns count, what was said of the untouched logs, and what could not be put in or gave no answer."""
    notes = [
        "size right: within 25 % of what was put in, of answers that give a size. covered: its 90 % interval holds "
        "that. extra: a name that neither the effect nor the untouched log has. nothing: unknown or none."
    ]
    for one in answer["backgrounds"]:
        if one["names"] is not None:
            notes.append(f"{one['name']}, untouched: {' + '.join(one['names']) or 'nothing named'}.")
    totals = answer["totals"]
    if totals["in_control"]:
        notes.append(
            f"In {totals['in_control']} of {totals['trials']} trials the untouched log has the effect's name too; "
            "their sizes are what was found on top of it."
        )
    short = max(totals["needed"][key] for key in ("held", "extra", "nothing_named"))
    if totals["trials"] < short:
        notes.append(f"Too few trials for intervals of ± 5 points: {totals['trials']}, which take some {short}.")
    if answer["skipped"]:
        left_out = sorted({one["effect"] for one in answer["skipped"]})
        notes.append(f"Not put in front of every log, where they would change nothing: {', '.join(left_out)}.")
    if answer["failed"]:
        notes.append(f"{answer['answerer']} gave no answer to {answer['failed']}: {answer['failures'][0]}")
    return [*notes, *answer["notes"]]


def _interval(interval: list[float] | None) -> str:
    return "-" if interval is None else f"{100 * interval[0]:.0f}-{100 * interval[1]:.0f} %"
