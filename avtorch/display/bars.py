"""Bars for two places: below a notebook's cell, as HTML that is updated in place, and on a terminal."""

from __future__ import annotations

import sys
from html import escape
from typing import Any, Protocol

from avtorch.display.notebook import notebook_display


class Bar(Protocol):
    """Shows `text` and the `share` that is done, 0 to 1; closed, it is gone."""

    def show(self, text: str, share: float) -> None: ...

    def close(self) -> None: ...


class NoBar:
    """Where there is no place for one."""

    def show(self, text: str, share: float) -> None:
        pass

    def close(self) -> None:
        pass


class NotebookBar:
    """One output of the cell; closed, it is empty: a notebook cannot take back a single output."""

    def __init__(self, display: Any) -> None:
        self._display, self._output = display, None

    def show(self, text: str, share: float) -> None:
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


class TerminalBar:
    """A line on standard error."""

    def __init__(self) -> None:
        self._bar, self._task = None, None

    def show(self, text: str, share: float) -> None:
        from rich.markup import escape as plain
        from rich.progress import BarColumn, Progress, TextColumn

        if self._bar is None:
            from rich.console import Console

            columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.percentage:>3.0f} %"))
            self._bar = Progress(*columns, console=Console(file=sys.stderr), transient=True)
            self._task = self._bar.add_task("", total=1.0)
            self._bar.start()
        self._bar.update(self._task, description=plain(text), completed=share)  # type: ignore[arg-type]

    def close(self) -> None:
        if self._bar is not None:
            self._bar.stop()


def bar_here() -> Bar:
    """The bar for the place where this program runs."""
    display = notebook_display()
    if display is not None:
        return NotebookBar(display)
    return TerminalBar() if sys.stderr.isatty() else NoBar()
