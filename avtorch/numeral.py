"""The numbers that avtorch reads from text: decimal, with ASCII digits and a point."""

from __future__ import annotations

import re

# Python also takes 1_000, the digits of other scripts and any space of Unicode around them; no recorder writes those
ODD = re.compile(r"[^\t -^`-~]")
"""A character that is in no number, not even around it; of ASCII: control characters and the underscore."""


def numeral(text: str) -> float:
    """The number that `text` writes, such as `-1.5e-3`, with spaces or tabs around it.

    `nan` and `inf` are read too, and a number too large for float64 is infinite: callers refuse what is not finite.
    Raises ValueError for any other text.
    """
    if ODD.search(text):
        raise ValueError("no decimal number in ASCII")
    return float(text)
