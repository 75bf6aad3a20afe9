"""Bars for three places: below a notebook's cell, as HTML that is updated in place, on a terminal, and in lines."""

from __future__ import annotations

import sys
from collections.abc import Callable
from html import escape
from typing import TYPE_CHECKING, Any

from avtorch.display.notebook import notebook_display

if TYPE_CHECKING:
    from rich.console import Console


class Bar:
    """Where there is no place for one: shows nothing.

    `show` takes the work's `title`, its stage `what` or "", the `share` that is done, 0 to 1, and the time left [s],
    None where it is not known. Closed, the bar is gone.
    """

    def show(self, title: str, what: str, share: float, left_s: float | None) -> None:
        pass

    def close(self) -> None:
        pass


class NotebookBar(Bar):
    """One output of the cell; closed, it is empty: a notebook cannot take back a single output."""

    def __init__(self, display: Any) -> None:
        self._display, self._output = display, None

    def show(self, title: str, what: str, share: float, left_s: float | None) -> None:
        text = _text(title, what, left_s)
        html = f'<progress max="1" value="{share:.3f}" aria-label="{escape(text)}"></progress> {escape(text)}'
        self._put({"text/html": html, "text/plain": f"{share:.0%} {text}"})

    def close(self) -> None:
        if self._output is not None:
            self._put({"text/html": "", "text/plain": ""})

    def _put(self, data: dict[str, str]) -> None:
        if self._output is None:
            self._output = self._display.display(data, raw=True, display_id=True)
        else:
            self._output.update(data, raw=True)


class TerminalBar(Bar):
    """A line on the terminal that is updated in place."""

    def __init__(self, console: Console) -> None:
        from rich.progress import BarColumn, Progress, TextColumn

        columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.percentage:>3.0f} %"))
        self._bar = Progress(*columns, console=console, transient=True)
        self._task = self._bar.add_task("", total=1.0)

    def show(self, title: str, what: str, share: float, left_s: float | None) -> None:
        from rich.markup import escape as plain

        self._bar.start()
        self._bar.update(self._task, description=plain(_text(title, what, left_s)), completed=share)

    def close(self) -> None:
        self._bar.stop()


class Lines(Bar):
    """Lines by `tell`, of the share that is done, and of what comes before anything is done and tells its own time."""

    def __init__(self, tell: Callable[[str], None]) -> None:
        self._tell = tell

    def show(self, title: str, what: str, share: float, left_s: float | None) -> None:
        if left_s is not None:
            self._tell(f"{title}: {100 * share:.0f} %, about {left_s:.0f} s left{what and f' ({what})'}")
        elif share == 0 and "," in what:
            self._tell(f"{title}: {what}")


def _text(title: str, what: str, left_s: float | None) -> str:
    text = f"{title}: {what}" if what else title
    return text if left_s is None else f"{text}, about {left_s:.0f} s left"


def bar_here() -> Bar:
    """The bar for the place where this program runs."""
    display = notebook_display()
    if display is not None:
        return NotebookBar(display)
    if not sys.stderr.isatty():
        return Bar()
    from rich.console import Console

    return TerminalBar(Console(file=sys.stderr))
