"""Is what a command printed what a page shows of it?"""

from __future__ import annotations

import re

_NUMBER = re.compile(r"[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?")
_BAR = re.compile("[▏▎▍▌▋▊▉█]+")

# Other processors round otherwise, and a search may end a few steps earlier: 2 % of a number, and 1 in its last place.
_SHARE = 0.02


def matches(printed: str, shown: str) -> bool:
    """Every word of `shown` in its place, and every number nearly; `...` stands for anything.

    Spaces, ends of lines and the length of bars do not count.
    """
    rest, parts = _words(printed), [_words(part) for part in shown.split("...")]
    for i, part in enumerate(parts):
        end = len(rest) - len(part)
        places = [k for k in range(end + 1) if (i > 0 or k == 0) and (i < len(parts) - 1 or k == end)]
        at = next((k for k in places if all(map(_same, rest[k : k + len(part)], part))), None)
        if at is None:
            return False
        rest = rest[at + len(part) :]
    return True


def _words(text: str) -> list[str]:
    return _BAR.sub("", text).split()


def _same(printed: str, shown: str) -> bool:
    """Equal but for numbers, which are nearly so."""
    if _NUMBER.sub("#", printed) != _NUMBER.sub("#", shown):
        return False
    pairs = zip(_NUMBER.findall(printed), _NUMBER.findall(shown), strict=True)
    return all(abs(float(a) - float(b)) <= _SHARE * abs(float(b)) + 1.01 * _last_place(b) for a, b in pairs)


def _last_place(number: str) -> float:
    digits, _, power = number.partition("e")
    return 10.0 ** (int(power or 0) - len(digits.partition(".")[2]))
