"""What the header of a column says: its words and its unit."""

from __future__ import annotations

import re
from dataclasses import dataclass
from itertools import chain

from avtorch.io.unit_names import unit_named

_BRACKETS = re.compile(r"^(?P<name>.*?)[\s_.,-]*[\[(<{](?P<unit>[^\])>}]*)[\])>}]\s*$")
_BEHIND = re.compile(r"^(?P<name>.*?)(?:,\s*|\s+in\s+|\s*/\s+|[\s_.]+)(?P<unit>[^\s_.,]+)$")
_WORDS = re.compile(r"[A-ZÄÖÜ]+(?![a-zäöüß])|[A-ZÄÖÜ]?[a-zäöüß]+|\d+")

# letters that are as likely part of a name
_ONLY_IN_BRACKETS = {"g", "s", "m", "h", "a", "min", "gs", "ms", "rad", "second", "meter"}
_BARE = {"g": {"accel", "accel_cmd"}, "ms": {"time"}, "s": {"time"}}


@dataclass(frozen=True)
class Header:
    """A column's `name`, its `words` in lower case, and the `unit` it states in avtorch's spelling, or None.

    `bare`: a last word that may be a unit or part of the name, such as the g of `acc_g`. `endings`: the words of the
    last part of a path, of the last two, and so on to all.
    """

    name: str
    words: tuple[str, ...]
    unit: str | None = None
    bare: str | None = None
    endings: tuple[tuple[str, ...], ...] = ()


def header_of(name: str, stated: str | None = None) -> Header:
    """What a column's name says; `stated`: its unit by a row of units or the file's own format."""
    rest, unit, bare = name, unit_named(stated) if stated else None, None
    bracketed = _BRACKETS.match(name)
    if bracketed is not None:
        rest = bracketed["name"]
        unit = unit or unit_named(bracketed["unit"])
    elif (behind := _BEHIND.match(name)) is not None and (found := unit_named(behind["unit"])) is not None:
        amperes = behind["unit"] == "A" and behind["name"].islower()  # as of current_A
        if behind["unit"].lower() in _ONLY_IN_BRACKETS and not amperes:
            bare = found
        else:
            rest, unit = behind["name"], unit or found
    parts = [_words(part) for part in rest.split("/")]
    if unit is None and bare is None and parts[-1] and (found := _inside(parts[-1][-1])) is not None:
        unit, parts[-1] = found[0], (*parts[-1][:-1], found[1])
    endings = [tuple(chain.from_iterable(parts[i:])) for i in reversed(range(len(parts)))]
    return Header(name, endings[-1], unit, bare, tuple(dict.fromkeys(words for words in endings if words)))


def _words(text: str) -> tuple[str, ...]:
    return tuple(word.lower() for word in _WORDS.findall(text))


def _inside(word: str) -> tuple[str, str] | None:
    """A unit at the end of a single word, such as `speedkph`, and what stands before it."""
    for form in ("kmph", "kmh", "kph", "mph", "mps2", "mps"):
        if word.endswith(form) and len(word) > len(form):
            return unit_named(form) or form, word[: -len(form)]
    return None


def bare_unit(header: Header, signal: str) -> str | None:
    """The unit that the last word of a name is for a signal, if it may be one."""
    last = header.bare
    return last if last is not None and signal in _BARE.get(last, {signal}) else None
