"""Files from outside, opened with care: regular files only, of a bounded size, and one line for everything else.

TOML is parsed in bounded time; an error names its line and quotes none of its content.
"""

from __future__ import annotations

import os
import re
import stat
import tomllib
from typing import Any, BinaryIO

from avtorch.errors import InputError, printable

MOST_BYTES = 512 * 2**20
"""Maximum size of a file."""

MOST_COLUMNS = 10_000

MOST_CELLS = 20_000_000
"""Maximum of the used columns: seven hours of four signals at 200 Hz, about 1.3 GB while they are read."""


_PATH = 200  # characters of a path in a message


class TooLarge(InputError):
    """A file with more bytes than its reader takes."""


def place(path: str | os.PathLike[str]) -> str:
    """A path as messages, notes and answers show it: escaped, and cut in its middle beyond 200 characters."""
    return printable(os.fspath(path), _PATH)


def opened(path: str | os.PathLike[str], *, need: str, links: bool = True) -> BinaryIO:
    """A regular file, open for reading bytes; the caller closes it. `need` names the expected file in messages.

    The checks look at the opened file, so it cannot be exchanged in between, and opening never waits: a pipe without a
    writer, a device or a directory is refused at once. `links` False refuses a symbolic link too. Raises InputError.
    """
    shown = place(path)
    # O_NONBLOCK: a pipe would wait for its writer; both flags are missing on Windows, where neither is needed
    flags = os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_CLOEXEC", 0) | getattr(os, "O_BINARY", 0)
    if not links and os.path.islink(path):
        raise InputError(f"{shown}: is a symbolic link; {need} is needed")
    try:
        handle = os.open(path, flags)
    except FileNotFoundError:
        raise InputError(f"{shown}: no such file") from None
    except (OSError, ValueError) as fault:
        if os.path.isdir(path):  # what Windows says only when it is opened
            raise InputError(f"{shown}: is a directory; {need} is needed") from None
        reason = fault.strerror or type(fault).__name__ if isinstance(fault, OSError) else printable(str(fault), 80)
        raise InputError(f"{shown}: cannot be read ({reason}); {need} is needed") from None
    try:
        mode = os.fstat(handle).st_mode
        if not stat.S_ISREG(mode):
            raise InputError(
                f"{shown}: is {'a directory' if stat.S_ISDIR(mode) else 'no regular file'}; {need} is needed"
            )
        return os.fdopen(handle, "rb")
    except BaseException:
        os.close(handle)
        raise


def beginning(path: str | os.PathLike[str], count: int, *, need: str) -> bytes:
    """The first `count` bytes of a regular file, fewer where it is shorter. Raises InputError."""
    with opened(path, need=need) as stream:
        return stream.read(count)


def read_regular(path: str | os.PathLike[str], *, most: int, need: str, links: bool = True) -> bytes:
    """The content of a regular file of up to `most` bytes, opened as by `opened`. Raises InputError, for more bytes
    `TooLarge`."""
    with opened(path, need=need, links=links) as stream:
        try:
            size = os.fstat(stream.fileno()).st_size
            # some files of the system say that they hold nothing: what is read counts, not what is said
            raw = b"" if size > most else _read(stream, most + 1)
        except OSError as fault:
            raise InputError(f"{place(path)}: cannot be read ({fault.strerror or type(fault).__name__})") from None
    if max(size, len(raw)) > most:
        raise TooLarge(f"{place(path)}: has {max(size, len(raw)):,} bytes; needs {most:,} at most")
    return raw


def _read(stream: BinaryIO, most: int) -> bytes:
    """Up to `most` bytes, in pieces, so that memory is allocated only for what is there."""
    pieces, left = [], most
    while left > 0 and (piece := stream.read(min(left, 2**20))):
        pieces.append(piece)
        left -= len(piece)
    return b"".join(pieces)


MOST_TOML = 1_000_000
"""Largest TOML file that is read."""

_MOST_DOTS = 64  # of one key; the parser takes quadratic time in them


def read_toml(path: str | os.PathLike[str], *, links: bool = True) -> dict[str, Any]:
    """The tables of a TOML file of up to 1 MB; `links` False refuses a symbolic link. Raises InputError."""
    raw = read_regular(path, most=MOST_TOML, need="a TOML file", links=links)
    try:
        text = raw.decode("utf-8-sig")
    except UnicodeDecodeError as fault:
        line = raw[: fault.start].count(b"\n") + 1
        raise InputError(f"{place(path)}: line {line}: is not UTF-8 text; a TOML file is needed") from None
    return parse_toml(text, place(path))


def parse_toml(text: str, where: str) -> dict[str, Any]:
    """The tables of a TOML text; `where` begins the message. Raises InputError that names the line."""
    if len(text) > MOST_TOML:
        raise InputError(f"{where}: has {len(text):,} characters; needs {MOST_TOML:,} at most")
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
