"""Windows on the disk as they are finished: a line of JSON each, while the answer is still on its way."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

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
    try:
        out.mkdir(parents=True, exist_ok=True)
        with path.open("w", encoding="utf-8") as stream:

            def write(window: WatchedWindow) -> None:
                stream.write(json_text(window_entry(window), indent=None).strip() + "\n")
                stream.flush()

            yield write
        path.unlink()
    except OSError as fault:
        raise InputError(
            f"{path}: cannot be written ({fault.strerror}); the windows go there as they are done"
        ) from None
