"""How far a long call is: a bar below a notebook's cell or on a terminal, gone when the call ends.

Example:
    >>> from avtorch import GLVDPlant, Leader, estimate, simulate
    >>> run = simulate(Leader.default(start=50.0, duration=2.0, dt=0.02), plant=GLVDPlant(0.5, 0.9))
    >>> found = estimate(run.log(), progress=True)  # no bar: it takes less than a second
    >>> len(found.windows)
    1
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from functools import wraps
from typing import Any, ParamSpec, TypeVar

from avtorch.display.bars import Bar, bar_here
from avtorch.display.notebook import notebook_display
from avtorch.threads import one_thread

AFTER_S = 1.0
"""A work that takes less shows no bar [s]."""
_EVERY_S = 0.2

P = ParamSpec("P")
R = TypeVar("R")
Called = TypeVar("Called", bound=Callable[..., None])

_shown: ContextVar[bool] = ContextVar("avtorch_progress_bar", default=False)


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


def asks_for_bar(progress: object) -> bool:
    """Whether `progress` of a long call means a bar here: True does, and None in a notebook."""
    return progress is True or (progress is None and notebook_display() is not None)


def shows_progress(function: Callable[P, R]) -> Callable[P, R]:
    """Gives `function`, a long call, the bar that its keyword `progress` asks for (see `asks_for_bar`), and one thread
    (see `avtorch.threads`)."""

    @wraps(function)
    def inner(*args: P.args, **kwargs: P.kwargs) -> R:
        with one_thread():
            if asks_for_bar(kwargs.get("progress")):
                with progress_bar(function.__name__.replace("_", " ")) as step:
                    return function(*args, **{**kwargs, "progress": step})  # type: ignore[arg-type]
            return function(*args, **kwargs)

    return inner


def called(progress: Called | bool | None) -> Called | None:
    """`progress` of a function behind `shows_progress`, where it is a callback; otherwise None."""
    return None if isinstance(progress, bool) else progress
