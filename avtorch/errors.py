"""The one error a user meets for bad input, and how foreign text stands in it."""

from __future__ import annotations

import unicodedata
from collections.abc import Iterable
from itertools import accumulate, takewhile

_LONGEST = 1000  # characters of a message
_NAME, _NAMES, _LIST = 120, 12, 360  # characters of a name in a list, names, and characters of the list


class InputError(ValueError):
    """Bad input, reported in one line: the argument, or the file, row and column; what was found; what would be right.

    Whatever text a file brought into the message, it stays one printable line of at most 1000 characters. The command
    line prints it to stderr and exits with code 2.

    Example:
        >>> from avtorch import GLVD, InputError
        >>> try:
        ...     GLVD(T_L=-0.3, K_L=1.0)
        ... except InputError as error:
        ...     print(error)
        T_L: found -0.3, needs finite and > 0 s
    """

    def __init__(self, message: object = "") -> None:
        super().__init__(printable(str(message), _LONGEST))


def printable(text: str, most: int | None = None) -> str:
    """`text` with every control character escaped, and with its middle left out where it has over `most` characters.

    Escaped are line ends, terminal sequences, marks that turn the direction of writing, and halves of surrogate pairs:
    all that Unicode does not count as printable, but for the widths of a space.
    """
    if most is not None and len(text) > most:
        text = _shortened(text, most)
    if not text.isprintable():
        characters = (c if c.isprintable() or unicodedata.category(c) == "Zs" else _escape(c) for c in text)
        text = "".join(characters)
        if most is not None and len(text) > most:
            text = _shortened(text, most)
    return text


def quoted(text: str, most: int = 40) -> str:
    """`text` in quotation marks, escaped and shortened, with the number of characters left out behind it."""
    if len(text) <= most:
        return repr(text)
    return f"{text[:most]!r}... ({len(text) - most} more characters)"


def listed(names: Iterable[str]) -> str:
    """The first of `names`, escaped, and the number of the rest: a dozen at most, and of long ones fewer, as each is
    whole up to 120 characters so that it can be copied."""
    all_ = [printable(name, _NAME) for name in names]
    shown = list(takewhile(lambda so_far: len(so_far) <= _LIST, accumulate(all_[:_NAMES], "{}, {}".format)))
    listing = shown[-1] if shown else ""
    rest = len(all_) - len(shown)
    return f"{listing} and {rest} more" if rest > 0 else listing


def _shortened(text: str, most: int) -> str:
    half = (most - 3) // 2
    return f"{text[:half]}...{text[-half:]}"


def _escape(c: str) -> str:
    return c.encode("unicode_escape").decode("ascii")
