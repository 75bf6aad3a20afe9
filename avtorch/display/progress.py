"""How far a long call is: a bar below a notebook's cell or on a terminal, gone when the call ends.

Example:
    >>> from avtorch import GLVDPlant, Leader, estimate, simulate
    >>> run = simulate(Leader.default(start=50.0, duration=2.0, dt=0.02), plant=GLVDPlant(0.5, 0.9))
    >>> found = estimate(run.log(), progress=True)  # no bar: it takes less than a second
    >>> len(found.windows)
    1
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from functools import wraps
from html import escape
from typing import TYPE_CHECKING, Any, ParamSpec, TypeVar

from avtorch.display.frame import notebook_display
from avtorch.threads import one_thread

if TYPE_CHECKING:
    from rich.console import Console

AFTER_S = 1.0
"""A work that takes less shows no bar [s]."""
_EVERY_S = 0.2

P = ParamSpec("P")
R = TypeVar("R")
Called = TypeVar("Called", bound=Callable[..., None])

_shown: ContextVar[bool] = ContextVar("avtorch_progress_bar", default=False)


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


class Steps:
    """Called with (done, of), or (what, done, of) where there are stages; shows them on a bar every `every_s` [s].

    What comes before anything is done, such as a simulator that is driven first, tells its own time after a comma: that
    is shown as it begins, and the time left is counted from its end.
    """

    def __init__(self, title: str, bar: Bar, every_s: float | None = None) -> None:
        self._title, self._bar = title, bar
        self._every_s = _EVERY_S if every_s is None else every_s
        self._begun = self._last = time.monotonic()
        self._first = ""

    def __call__(self, *told: Any) -> None:
        *stage, done, of = told
        what, now = stage[0] if stage else "", time.monotonic()
        if done == 0:
            self._begun = now
        if done == 0 and "," in what and what != self._first:
            self._first = what
        elif now - self._begun < AFTER_S or now - self._last < self._every_s:
            return
        self._last = now
        left_s = (now - self._begun) * (of - done) / done if 0 < done < of else None
        self._bar.show(self._title, what, min(done / of, 1.0) if of > 0 else 0.0, left_s)


@contextmanager
def progress_bar(title: str) -> Iterator[Callable[..., None]]:
    """A bar for a work of your own; yields a function of (done, of), or of (what, done, of) where there are stages.

    It stands below the cell in a notebook, and on standard error where that is a terminal. Elsewhere, within another
    bar and in the first second there is none. At the end it is gone.
    """
    bar = Bar() if _shown.get() else bar_here()
    token = _shown.set(True)
    try:
        yield Steps(title, bar)
    finally:
        _shown.reset(token)
        bar.close()


def shows_progress(function: Callable[P, R]) -> Callable[P, R]:
    """Gives `function`, a long call, a bar where its keyword `progress` is True, or None in a notebook, and one thread
    (see `avtorch.threads`)."""

    @wraps(function)
    def inner(*args: P.args, **kwargs: P.kwargs) -> R:
        progress = kwargs.get("progress")
        with one_thread():
            if progress is True or (progress is None and notebook_display() is not None):
                with progress_bar(function.__name__.replace("_", " ")) as step:
                    return function(*args, **{**kwargs, "progress": step})  # type: ignore[arg-type]
            return function(*args, **kwargs)

    return inner


def called(progress: Called | bool | None) -> Called | None:
    """`progress` of a function behind `shows_progress`, where it is a callback; otherwise None."""
    return None if isinstance(progress, bool) else progress
