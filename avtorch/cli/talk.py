"""Everything a command prints: notes, progress, tables, where the files are; and how its answer is written."""

from __future__ import annotations

import json
import os
import webbrowser
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from rich.console import Console, ConsoleOptions, RenderableType
from rich.markup import escape
from rich.segment import Segment
from rich.status import Status
from rich.table import Table as Drawn

from avtorch.errors import printable

if TYPE_CHECKING:
    from avtorch.report.table import Table

EVERY_S = float(os.environ.get("AVTORCH_PROGRESS_S", 10.0))
"""Wall-clock time between two lines of progress [s]; a command that takes less prints none. A program that starts the
command may ask for more of them."""


class SafeConsole(Console):
    """A console that sends its own styles and cursor movements to the terminal, but only visible characters of any
    text.

    Names of files and columns may hold terminal sequences or turn the direction of writing: they are shown escaped.
    """

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterable[Segment]:
        for segment in super().render(renderable, options):
            if segment.control is None and not segment.text.isprintable():
                lines = segment.text.split("\n")
                segment = Segment("\n".join(map(printable, lines)), segment.style)
            yield segment


class Talk:
    """Prints tables and progress. With `json` it prints the answer in place of the tables; with `quiet` nothing."""

    def __init__(self, *, json: bool, quiet: bool) -> None:
        self.json, self.silent = json and not quiet, quiet or json
        self.out = SafeConsole(quiet=self.silent, highlight=False)
        self.err = SafeConsole(stderr=True, quiet=self.silent, highlight=False)

    @contextmanager
    def progress(self, what: str) -> Iterator[Callable[..., None]]:
        """A bar with the time left on stderr where it is a terminal, and a line now and then where it is not; yields a
        function of (done, of), or of (stage, done, of) where there are stages."""
        # not before a command works: the package needs NumPy
        from avtorch.display.progress import Lines, Steps, TerminalBar

        terminal = self.err.is_terminal and not self.silent
        lines = Lines(lambda text: self.err.print(text, markup=False, soft_wrap=True))
        bar = TerminalBar(self.err) if terminal else lines
        try:
            yield Steps(what, bar, None if terminal else EVERY_S)
        finally:
            bar.close()

    def waiting(self, what: str) -> Status:
        """A sign of life on a terminal, for as long as its `with` lasts."""
        return self.err.status(what)

    def notes(self, title: str, notes: Sequence[str]) -> None:
        """A title and lines below it."""
        self.out.print(title, style="bold", markup=False)
        for note in notes:
            self.out.print(f"  {note}", markup=False)
        self.out.print()

    def line(self, text: str, style: str | None = None) -> None:
        """A line that the terminal wraps and not the printing, so that a path in it can be copied."""
        self.out.print(text, style=style, markup=False, soft_wrap=True)

    def lines(self, lines: Iterable[str], style: str | None = None) -> None:
        """Sentences, a paragraph each."""
        for line in lines:
            self.out.print(line, style=style, markup=False)

    def table(self, table: Table, most: int | None = None) -> None:
        """A table of the page, `most` rows of it, and an empty line; nothing of one without rows."""
        if not table.rows:
            return
        self.out.print(drawn(table, most))
        more = 0 if most is None else len(table.rows) - most
        if more > 0:
            self.out.print(f"... and {more} more in the answer", style="dim")
        self.out.print()

    def answer(self, answer: Mapping[str, Any]) -> None:
        """The answer as JSON."""
        print(json.dumps(answer, default=lambda x: x.tolist()))

    def show(self, page: Path) -> None:
        """Open `page`, or say where it is: a machine without a screen has no browser."""
        if not webbrowser.open(page.absolute().as_uri()):
            self.line(f"No browser was found to open {page}")

    def done(self, out: Path, answer: Mapping[str, Any]) -> None:
        """The answer as JSON, or where its files are: all that a reader opens."""
        if self.json:
            self.answer(answer)
            return
        kinds = (".csv", ".html", ".json", ".md", ".png", ".toml", ".xml", ".yaml")
        there = sorted(p.name for p in out.iterdir() if p.suffix in kinds and p.is_file())
        self.out.print(f"\nWritten to [bold]{escape(str(out))}[/bold]: {escape(', '.join(there))}", soft_wrap=True)


def drawn(table: Table, most: int | None = None) -> Drawn:
    """A table of the page for the terminal, without the columns in which nothing stands."""
    shown = Drawn(box=None, header_style="bold", pad_edge=False, padding=(0, 2, 0, 0))
    kept = [i for i in range(len(table.columns)) if i == 0 or any(row[i] for row in table.rows)]
    # a name is not cut, so that it can be copied
    longest = max((len(word) for row in table.rows[:most] for word in row[0].split()), default=None)
    for i in kept:
        title = table.columns[i]
        side: Literal["left", "right"] = "right" if title in table.numeric else "left"
        shown.add_column(escape(title), justify=side, min_width=longest if i == 0 else None)
    for number, row in enumerate(table.rows[:most]):
        style = "bold" if number in table.marked else "dim" if number in table.soft else None
        shown.add_row(*(escape(printable(row[i])) for i in kept), style=style)
    return shown


def write_answer(
    out: Path,
    name: str,
    answer: Mapping[str, Any],
    pictures: Mapping[str, Callable[[], Any]] | None = None,
    pages: Mapping[str, Callable[[], str]] | None = None,
    *,
    more: Callable[[Path], object] = lambda staged: None,
) -> None:
    """Publish the answer, its pictures and its pages as one set; `more` writes further files into it."""
    from avtorch.io import answer_set, write_json
    from avtorch.plots import save
    from avtorch.report.page import written

    with answer_set(out, [name]) as staged:
        for file, draw in (pictures or {}).items():
            save(draw(), staged / file)
        for file, page in (pages or {}).items():
            written(page(), staged, file)
        more(staged)
        write_json(staged / name, answer)
