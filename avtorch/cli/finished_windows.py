"""Windows on the disk as they are finished: a line of JSON each, while the answer is still on its way."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, TextIO

from avtorch.errors import InputError

if TYPE_CHECKING:
    from avtorch.decision.watch import WatchedWindow

NAME = "windows.jsonl"
"""One line a window, each an entry of `windows` in `estimates.json`, which takes its place in the end."""


@contextmanager
def finished_windows(out: Path) -> Iterator[Callable[[WatchedWindow], None]]:
    """A function that writes a window to `NAME` in `out`; the file is removed where no exception is raised.

    After an interruption it holds the windows finished by then. Raises `InputError` where it cannot be written.
    """
    from avtorch.io.answers import json_text
    from avtorch.results import window_entry

    path = out / NAME
    with ExitStack() as opened:
        streams: list[TextIO] = []

        def write(window: WatchedWindow) -> None:
            try:
                if not streams:  # not before there is something to write: a refused log leaves no folder
                    out.mkdir(parents=True, exist_ok=True)
                    streams.append(opened.enter_context(path.open("w", encoding="utf-8")))
                streams[0].write(json_text(window_entry(window), indent=None).strip() + "\n")
                streams[0].flush()
            except OSError as fault:
                raise InputError(f"{path}: cannot be written ({fault.strerror}); windows go there when done") from None

        yield write
    if streams:
        path.unlink(missing_ok=True)
