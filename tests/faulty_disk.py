"""A file system that fails at the n-th call below one folder, or lets a test inspect that folder just before it.

Counted are the calls of `os` that make, rename, remove or open files, what streams opened for writing do (write, flush,
close), and optionally the calls that list or stat files.
"""

from __future__ import annotations

import builtins
import hashlib
import io
import os
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from errno import EIO, ENOSPC, EROFS
from pathlib import Path
from typing import Any

from avtorch.errors import InputError
from avtorch.io import read_answer

Call = Callable[[int, str], None]
"""Takes the number of a call, from 1 on, and its name; may raise in its place."""

ERRORS = (ENOSPC, EIO, EROFS)

_READS = ("readlink", "lstat", "stat", "scandir", "listdir")
_ONE_PATH = ("mkdir", "unlink", "remove", "rmdir", "chmod", *_READS)
_TWO_PATHS = ("replace", "rename", "link", "symlink")


def fails(at: int, *, onwards: bool) -> Call:
    """Fail at the call `at`, only there or from then on; the error goes round with `at`."""

    def call(n: int, name: str) -> None:
        if n == at or (onwards and n > at):
            raise OSError(ERRORS[at % len(ERRORS)], os.strerror(ERRORS[at % len(ERRORS)]))

    return call


def interrupts(at: int) -> Call:
    def call(n: int, name: str) -> None:
        if n == at:
            raise KeyboardInterrupt

    return call


def visible(folder: Path) -> dict[str, str]:
    """The content of a folder for a reader: each file's content by name, links followed, none of them dangling."""
    if not folder.is_dir():
        return {}
    return {
        p.name: hashlib.sha256(p.read_bytes()).hexdigest()
        for p in folder.iterdir()
        if p.is_file() and not p.name.startswith(".")
    }


def old_or_new(folder: Path, answer: str, old: dict[str, str], new: dict[str, str]) -> str:
    """What a reader finds of the JSON `answer` and its files: `old`, `new`, or `mixed`, which `read_answer` refuses.

    Each file is whole, the old one or the new one; and what is not refused is all of one answer.
    """
    seen = visible(folder)
    for name in old.keys() | new.keys() | seen.keys():
        assert seen.get(name) in (old.get(name), new.get(name)), name
    try:
        files = read_answer(folder / answer).get("files", {})
    except InputError:
        assert seen != new
        return "old" if seen == old else "mixed"
    listed = {name: seen[name] for name in (answer, *files)}
    if listed.items() <= new.items() and seen == new:
        return "new"
    assert listed.items() <= old.items() or listed.items() <= new.items()
    return "old" if listed.items() <= old.items() else "new"


def tree(folder: Path) -> tuple[tuple[str, str], ...]:
    """The whole content of a folder, hidden files included; equal for folders that differ only in the names of sets."""
    found = []
    for path in sorted(folder.rglob("*")) if folder.is_dir() else ():
        if path.is_symlink():
            what = f"link to {os.readlink(path)}"
        elif path.is_dir() or path.suffix == ".lock":  # it contains the time it was made
            what = path.suffix or "folder"
        else:
            what = hashlib.sha256(path.read_bytes()).hexdigest()
        found.append((str(path.relative_to(folder)), what))
    called: dict[str, str] = {}

    def same(text: str) -> str:
        passing = r"(?<=\.avtorch-)\w+|(?<=\.)\w{8}(?=\.part)"
        return re.sub(passing, lambda m: called.setdefault(m.group(), f"<{len(called)}>"), text)

    # in the order of what they hold, as the names are drawn by chance
    by_content = sorted(found, key=lambda one: (re.sub(r"\.avtorch-\w+|\.\w{8}\.part", "", one[0]), one[1]))
    return tuple((same(name), same(what)) for name, what in by_content)


class _Stream:
    """A stream whose writes, flushes and closing are counted."""

    def __init__(self, stream: Any, count: Callable[[str], None]) -> None:
        self._stream, self._count = stream, count

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def __enter__(self) -> _Stream:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def write(self, content: Any) -> int:
        self._count("write")
        return self._stream.write(content)

    def writelines(self, lines: Any) -> None:
        for line in lines:
            self.write(line)

    def flush(self) -> None:
        self._count("flush")
        self._stream.flush()

    def close(self) -> None:
        # what cannot be flushed is lost, the handle is not
        self._stream.close()
        self._count("close")


@contextmanager
def disk(root: Path, call: Call, *, reads: bool = True) -> Iterator[list[str]]:
    """Let `call` come before every call on a path below `root`; yields the names of the calls so far.

    `reads` False leaves the calls out that change nothing.
    """
    names: list[str] = []
    handles: dict[int, str] = {}
    looking = False
    real: dict[str, Any] = {name: getattr(os, name) for name in (*_ONE_PATH, *_TWO_PATHS, "open", "fsync", "fdopen")}
    real_open = builtins.open

    def count(name: str) -> None:
        nonlocal looking
        if looking or (name in _READS and not reads):
            return
        names.append(name)
        looking = True  # what `call` itself does is not counted
        try:
            call(len(names), name)
        finally:
            looking = False

    def below(path: Any, dir_fd: int | None = None) -> str | None:
        if isinstance(path, int):
            return handles.get(path)
        text = os.fspath(path)
        if isinstance(text, bytes):
            return None
        if dir_fd is not None:
            return None if dir_fd not in handles else os.path.join(handles[dir_fd], text)
        text = os.path.abspath(text)
        return text if text == str(root) or text.startswith(f"{root}{os.sep}") else None

    def one_path(name: str) -> Any:
        def inner(path: Any = ".", *args: Any, **more: Any) -> Any:
            if below(path, more.get("dir_fd")) is not None:
                count(name)
            return real[name](path, *args, **more)

        return inner

    def two_paths(name: str) -> Any:
        def inner(source: Any, target: Any, *args: Any, **more: Any) -> Any:
            if below(target, more.get("dst_dir_fd")) is not None:
                count(name)
            return real[name](source, target, *args, **more)

        return inner

    def opened(path: Any, flags: int, *args: Any, **more: Any) -> int:
        place = below(path, more.get("dir_fd"))
        if place is not None:
            count("open")
        handle = real["open"](path, flags, *args, **more)
        handles.pop(handle, None)
        if place is not None:
            handles[handle] = place
        return handle

    def fsync(handle: int) -> None:
        if handle in handles:
            count("fsync")
        else:
            real["fsync"](handle)

    def stream_of(name: str, function: Any) -> Any:
        def inner(file: Any, mode: str = "r", *args: Any, **more: Any) -> Any:
            if below(file) is None or not set(mode) & set("wax+"):
                return function(file, mode, *args, **more)
            count(name)
            return _Stream(function(file, mode, *args, **more), count)

        return inner

    patched = {name: one_path(name) for name in _ONE_PATH} | {name: two_paths(name) for name in _TWO_PATHS}
    patched |= {"open": opened, "fsync": fsync, "fdopen": stream_of("fdopen", real["fdopen"])}
    try:
        for name, function in patched.items():
            setattr(os, name, function)
        builtins.open = io.open = stream_of("open", real_open)  # type: ignore[assignment]
        yield names
    finally:
        for name, function in real.items():
            setattr(os, name, function)
        builtins.open = io.open = real_open
