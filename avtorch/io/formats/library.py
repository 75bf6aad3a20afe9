"""A library that reads a format: loaded when a file asks for it; its errors become one line."""

from __future__ import annotations

import importlib
import importlib.util
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import ModuleType

from avtorch.errors import InputError, printable
from avtorch.io.formats.kinds import Kind

_REASON = 160  # characters of a library's message


def refuse_missing(source: str, kind: Kind) -> None:
    """Raises InputError saying what to install where the library of `kind` is not there; nothing is loaded."""
    if kind.library is not None and importlib.util.find_spec(kind.library.module) is None:
        raise InputError(
            f"{source}: is {kind.words}; reading it needs {kind.library.package}: "
            f"pip install 'avtorch[{kind.library.extra}]'"
        )


def library(module: str, source: str, kind: Kind) -> ModuleType:
    """A module of the library of `kind`, or of one that comes with the same extra.

    Raises InputError for one that is not there or cannot be loaded, such as one that lacks a part of its own.
    """
    try:
        return importlib.import_module(module)
    except Exception as fault:
        extra = kind.library.extra if kind.library is not None else ""
        raise InputError(
            f"{source}: is {kind.words}; reading it needs {module}, which cannot be loaded here ({reason(fault)}): "
            f"pip install --force-reinstall 'avtorch[{extra}]'"
        ) from None


@contextmanager
def guarded(where: str | Callable[[], str], need: str) -> Iterator[None]:
    """Within it, any error of a library becomes an InputError: `where` is the file, with the channel where one is
    read, or tells it when asked; `need` says what would be right."""
    try:
        yield
    except InputError:
        raise
    except BaseException as fault:
        # a panic of a library in Rust is no Exception; an interruption by the user is none either, and goes on
        panic = type(fault).__name__ == "PanicException"
        if not (panic or isinstance(fault, Exception)):
            raise
        what = "is damaged" if panic else "is damaged or of an unknown kind"
        at = where if isinstance(where, str) else where()
        raise InputError(f"{at}: {what} ({reason(fault)}); {need} is needed") from None


def reason(fault: BaseException) -> str:
    """A library's message: one short line without the paths it may hold."""
    text = next((line.strip() for line in str(fault).splitlines() if line.strip()), "")
    text = " ".join(os.path.basename(word) if word.count("/") > 2 else word for word in text.split())
    return printable(f"{type(fault).__name__}: {text}" if text else type(fault).__name__, _REASON)
