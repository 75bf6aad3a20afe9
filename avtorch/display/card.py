"""An answer in a few lines: a title, some sentences, a small table."""

from __future__ import annotations

from dataclasses import dataclass
from html import escape
from textwrap import wrap

from avtorch.display.frame import Frame
from avtorch.errors import printable

WIDTH = 100
"""Characters of a line of sentences."""
_SENTENCE = 600  # characters


@dataclass(frozen=True)
class Card:
    """A `title`, `lines` of one sentence each, and a `table`, of which `most` rows are drawn."""

    title: str
    lines: tuple[str, ...] = ()
    table: Frame | None = None
    most: int = 6

    def __str__(self) -> str:
        """As a console shows it."""
        table = [] if self.table is None or not len(self.table) else self.table.lines(self.most)
        sentences = (printable(line, _SENTENCE) for line in (self.title, *self.lines))
        return "\n".join([*(part for line in sentences for part in wrap(line, WIDTH)), *table])

    def html(self) -> str:
        """As a notebook shows it; every text escaped."""
        lines = "".join(f"<div>{escape(printable(line, _SENTENCE))}</div>" for line in self.lines)
        table = "" if self.table is None or not len(self.table) else self.table.html(self.most)
        return f"<div><strong>{escape(printable(self.title, _SENTENCE))}</strong>{lines}{table}</div>"


class Displayed:
    """An answer that shows its `overview()`: as text in a console, as HTML in a notebook."""

    def overview(self) -> Card:
        """The answer in a few lines."""
        raise NotImplementedError

    def __repr__(self) -> str:
        return str(self.overview())

    def _repr_html_(self) -> str:
        return self.overview().html()
