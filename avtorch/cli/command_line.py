"""The command as it was given, for answers that tell how they were made."""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from avtorch.report import Origin

_TOKENS: ContextVar[tuple[str, ...] | None] = ContextVar("tokens", default=None)


@contextmanager
def given(tokens: Sequence[str]) -> Iterator[None]:
    """Within it, `command_line` tells of these tokens."""
    before = _TOKENS.set(tuple(tokens))
    try:
        yield
    finally:
        _TOKENS.reset(before)


def command_line() -> str | None:
    """The command, quoted for a shell; None outside one."""
    tokens = _TOKENS.get()
    return None if tokens is None else shlex.join(["avtorch", *tokens])


def origin_of(paths: Sequence[Path], **settings: Any) -> Origin:
    """How an answer is made, by the files as they are now; a log's mapping file is one of them."""
    from avtorch.io.mapping import mapping_beside
    from avtorch.report import Origin

    beside = [place for place in (mapping_beside(path) for path in paths) if place is not None]
    return Origin.of(command_line(), [*paths, *beside], settings)
