"""The command as it was given, for answers that tell how they were made."""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar

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
