"""The tables of `avtorch paper`: one row per experiment or per claim, and a text on what was not reproduced."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from typing import Any

from rich.markup import escape
from rich.table import Table

_COLOURS = {"same": "green", "better": "bold green", "not reproduced": "yellow"}


def counts_table(answer: Mapping[str, Any]) -> Table:
    """Counts of the claims of each experiment by verdict."""
    table = Table(box=None, header_style="bold", pad_edge=False, padding=(0, 2, 0, 0))
    table.add_column("")
    for verdict in ("rows", *_COLOURS):
        table.add_column(verdict, justify="right")
    names = [row["name"] for row in answer["rows"]]
    for name in (*dict.fromkeys(names), "all"):
        counts = Counter(row["verdict"] for row in answer["rows"] if name in (row["name"], "all"))
        cells = (str(counts.total()), *(str(counts[verdict]) for verdict in _COLOURS))
        table.add_row(name, *cells, style="bold" if name == "all" else None)
    return table


def rows_table(answer: Mapping[str, Any]) -> Table:
    """One row per claim: quantity and place, the paper's value, ours with its 90 % interval, the verdict."""
    table = Table(box=None, header_style="bold", pad_edge=False, padding=(0, 2, 0, 0))
    table.add_column("", ratio=5)
    table.add_column("paper", ratio=3)
    table.add_column("here (90 %)", ratio=2)
    table.add_column("", no_wrap=True)
    for row in answer["rows"]:
        verdict = row["verdict"]
        asked = f"{escape(row['quantity'])}\n[dim]{escape(row['setting'])}[/dim]"
        table.add_row(asked, escape(formatted(row["paper"])), escape(here(row)), f"[{_COLOURS[verdict]}]{verdict}[/]")
    return table


def missed(answer: Mapping[str, Any]) -> list[str]:
    """What was not reproduced, and why."""
    rows = [row for row in answer["rows"] if row["verdict"] == "not reproduced"]
    if not rows:
        return ["\nEverything was reproduced."]
    found = [f"  {row['name']}: {row['quantity']} ({row['setting']}) is {here(row)}; {row['why']}" for row in rows]
    return ["\nNot reproduced:", *found]


def here(row: Mapping[str, Any]) -> str:
    """Our figure with its interval."""
    if row["interval"] is None:
        return formatted(row["ours"])
    low, high = (formatted(x) for x in row["interval"])
    return f"{formatted(row['ours'])} ({low} to {high})"


def formatted(value: Any) -> str:
    """A number in three digits, four around one (a peak gain of 1.077 must not read as one), or words as they are."""
    if isinstance(value, str):
        return value
    return f"{value:.4g}" if 0.9 < abs(value) < 2 else f"{value:.3g}"
