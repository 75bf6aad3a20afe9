"""A library that reads a format: loaded when a file asks for it, and never heard: its errors become one line."""

from __future__ import annotations

import importlib
import importlib.util
import io
import logging
import os
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
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
    with silenced():
        try:
            return importlib.import_module(module)
        except Exception as fault:
            extra = kind.library.extra if kind.library is not None else ""
            raise InputError(
                f"{source}: is {kind.words}; reading it needs {module}, which cannot be loaded here ({reason(fault)}): "
                f"pip install --force-reinstall 'avtorch[{extra}]'"
            ) from None


@contextmanager
def silenced() -> Iterator[None]:
    """Within it, libraries neither warn, nor log, nor print; what they say of a file goes into errors and remarks."""
    before = logging.root.manager.disable
    deaf = _Deaf()
    with warnings.catch_warnings(), redirect_stdout(deaf), redirect_stderr(deaf):
        warnings.simplefilter("ignore")
        logging.disable(logging.CRITICAL)
        try:
            yield
        finally:
            logging.disable(before)


@contextmanager
def guarded(where: str | Callable[[], str], need: str) -> Iterator[None]:
    """Within it, any error of a library becomes an InputError: `where` is the file, with the channel where one is
    read, or tells it when asked; `need` says what would be right."""
    with silenced():
        try:
            yield
        except InputError:
            raise
        except Exception as fault:
            raise InputError(
                f"{_told(where)}: is damaged or of an unknown kind ({reason(fault)}); {need} is needed"
            ) from None
        except BaseException as fault:
            # a panic of a library in Rust is no Exception; an interruption by the user is none either, and goes on
            if type(fault).__name__ != "PanicException":
                raise
            raise InputError(f"{_told(where)}: is damaged ({reason(fault)}); {need} is needed") from None


def _told(where: str | Callable[[], str]) -> str:
    return where if isinstance(where, str) else where()


class _Deaf(io.TextIOBase):
    def write(self, text: str) -> int:
        return len(text)


def reason(fault: BaseException) -> str:
    """A library's message: one short line without the paths it may hold."""
    text = next((line.strip() for line in str(fault).splitlines() if line.strip()), "")
    text = " ".join(os.path.basename(word) if word.count("/") > 2 else word for word in text.split())
    return printable(f"{type(fault).__name__}: {text}" if text else type(fault).__name__, _REASON)
