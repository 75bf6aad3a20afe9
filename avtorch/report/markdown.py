"""A page as Markdown, to paste: its words and tables, no pictures."""

from __future__ import annotations

import re
from collections.abc import Iterable

from avtorch.errors import printable
from avtorch.report.origin import Origin, versions
from avtorch.report.page import Page, Section
from avtorch.report.table import Table


def markdown(page: Page, origin: Origin | None = None) -> str:
    """The page as Markdown; whatever a file's name holds stays text."""
    made = origin or Origin()
    command = (f"    {printable(made.command)}",) if made.command else ()
    foot = [f"versions: {versions()}", *(f"SHA-256 of {name}: {digits}" for name, digits in made.files.items())]
    foot += [f"SHA-256 of the settings: {made.settings}"] if made.settings else []
    parts = [f"# {_text(page.kind)}", _text(page.of), f"**{_text(page.lead.title)}**", *_body(page.lead)]
    for section in page.sections:
        parts += [] if section.empty else [f"## {_text(section.title)}", *_body(section)]
    parts += ["## How this page was made", *command, *_body(Section("", items=tuple(foot)))]
    return "\n\n".join(parts) + "\n"


def _body(section: Section) -> list[str]:
    lists = ["\n".join(f"- {_text(item)}" for item in section.items)] if section.items else []
    return [*map(_text, section.lines), *map(_table, section.tables), *map(_text, section.soft), *lists]


def _table(table: Table) -> str:
    sides = ["---:" if title in table.numeric else "---" for title in table.columns]
    return "\n".join([_row(table.columns), _row(sides, raw=True), *map(_row, table.rows)])


def _row(cells: Iterable[str], *, raw: bool = False) -> str:
    return f"| {' | '.join(cells if raw else map(_text, cells))} |"


def _text(text: str) -> str:
    """With a backslash before all that Markdown would read otherwise."""
    return re.sub(r"([\\`*_{}\[\]<>#|])", r"\\\1", printable(text))
