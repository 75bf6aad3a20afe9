"""Untrusted TOML in bounded time: an error is one line with the line's number, and quotes none of its content."""

from __future__ import annotations

import os
import re
import tomllib
from typing import Any

from avtorch.errors import InputError, printable
from avtorch.io.opening import place, read_regular

MOST_BYTES = 1_000_000
"""Largest TOML file that is read."""

_MOST_DOTS = 64  # of one key; the parser takes quadratic time in them


def read_toml(path: str | os.PathLike[str], *, links: bool = True) -> dict[str, Any]:
    """The tables of a TOML file of up to 1 MB; `links` False refuses a symbolic link. Raises InputError."""
    raw = read_regular(path, most=MOST_BYTES, need="a TOML file", links=links)
    try:
        text = raw.decode("utf-8-sig")
    except UnicodeDecodeError as fault:
        line = raw[: fault.start].count(b"\n") + 1
        raise InputError(f"{place(path)}: line {line}: is not UTF-8 text; a TOML file is needed") from None
    return parse_toml(text, place(path))


def parse_toml(text: str, where: str) -> dict[str, Any]:
    """The tables of a TOML text; `where` begins the message. Raises InputError that names the line."""
    if len(text) > MOST_BYTES:
        raise InputError(f"{where}: has {len(text):,} characters; needs {MOST_BYTES:,} at most")
    if any(part.count(".") > _MOST_DOTS for part in re.split(r"[,=\n]", text)):
        raise InputError(f"{where}: is no TOML for avtorch: a key has more than {_MOST_DOTS} dots")
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as fault:
        reason, _, at = str(fault).rpartition(" (at ")
        line = at.removesuffix(")").replace("end of document", "its end")
        # the parser's reason may quote a key of the file, never a value; a short piece of it is enough
        raise InputError(f"{where}: {line}: is no readable TOML ({printable(reason, 80)})") from None
    except RecursionError:
        raise InputError(f"{where}: is no TOML for avtorch: it is nested too deeply") from None
    except (ValueError, OverflowError):  # a whole number of thousands of digits, a date that does not exist
        raise InputError(f"{where}: is no TOML for avtorch: a number or date in it is out of range") from None
