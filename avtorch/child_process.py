"""The other side of a pipe, for what runs in a process of its own: answers, and a limit of memory.

An answer is a line of JSON, and what it tells of behind it. It imports nothing that takes time to load.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from typing import Any, BinaryIO


def answers_to() -> BinaryIO:
    """Where answers go: where the output went. Whatever a library prints goes nowhere from now on."""
    out = os.fdopen(os.dup(1), "wb")
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    return out


def answer(out: BinaryIO, what: Mapping[str, Any], content: bytes = b"") -> None:
    """Write an answer and the `content` behind it."""
    out.write(json.dumps(what).encode() + b"\n" + content)
    out.flush()


def limit_memory(most: int) -> None:
    """At most so many bytes of address space, where the system can limit it; no core dumps."""
    try:
        import resource
    except ImportError:  # Windows
        return
    _, hard = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (most if hard < 0 else min(most, hard), hard))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
