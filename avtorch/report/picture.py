"""Pictures inside the page: SVG that takes its colours from the page's style, so that one picture serves light, dark
and paper."""

from __future__ import annotations

import io
import re
from collections.abc import Callable
from dataclasses import dataclass

import matplotlib as mpl
from markupsafe import Markup
from matplotlib.figure import Figure

from avtorch.errors import printable
from avtorch.plots.style import (
    AMPLIFIES,
    BLACK,
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    PURPLE,
    SKY,
    STABLE,
    UNSTABLE,
    VERMILLION,
)
from avtorch.report.table import Table

_COLOURS = {
    BLACK: "ink",
    "#000000": "ink",
    "#FFFFFF": "paper",
    BLUE: "p-blue",
    VERMILLION: "p-vermillion",
    ORANGE: "p-orange",
    SKY: "p-sky",
    GREY: "p-grey",
    GREEN: "p-green",
    PURPLE: "p-purple",
    STABLE: "p-stable",
    AMPLIFIES: "p-amplifies",
    UNSTABLE: "p-unstable",
    "#B07A1E": "p-contour",
    "#DCDCDC": "p-fill",
    "#BBBBBB": "p-bar",
    "#DDDDDD": "p-fill",
    "#E6E6E6": "p-grid",
}
"""Colours of the drawings by the style's name for them."""

_VARIABLES = {colour.lower(): f"var(--{name})" for colour, name in _COLOURS.items()}


@dataclass(frozen=True)
class Picture:
    """A picture as `wide` and `narrow` SVG, for a desk and for a phone; `says`: what it shows, in words; `caption`;
    `tables`: its numbers, shown at once where `opened`.

    Example:
        >>> from markupsafe import Markup
        >>> from avtorch.report.picture import Picture
        >>> Picture(Markup("<svg></svg>"), Markup("<svg></svg>"), says="Nothing.").opened
        False
    """

    wide: Markup
    narrow: Markup
    says: str
    caption: str = ""
    tables: tuple[Table, ...] = ()
    opened: bool = False


def picture_of(
    name: str, draw: Callable[[bool], Figure], says: str, *tables: Table, caption: str = "", opened: bool = False
) -> Picture:
    """What `draw` makes of False, for a desk, and of True, for a phone.

    Example:
        >>> from matplotlib.figure import Figure
        >>> from avtorch.report.picture import picture_of
        >>> picture_of("empty", lambda narrow: Figure(figsize=(1, 1)), "Nothing.").says
        'Nothing.'
    """
    wide, narrow = (inline_svg(f"{name}-{kind}", draw(kind == "narrow"), says) for kind in ("wide", "narrow"))
    return Picture(wide, narrow, says, caption, tables, opened)


def inline_svg(name: str, figure: Figure, says: str) -> Markup:
    """A figure as SVG for the page: text as text, no date, equal for equal figures.

    `name` begins its ids and is the page's only one; `says` is its text alternative. A colour of the house's palette
    becomes the style's variable.

    Example:
        >>> from matplotlib.figure import Figure
        >>> from avtorch.report.picture import inline_svg
        >>> inline_svg("empty", Figure(figsize=(1, 1)), "Nothing.")[:56]
        Markup('<svg class="picture" role="img" aria-label="Nothing." vi')
    """
    stream = io.StringIO()
    with mpl.rc_context({"svg.fonttype": "none", "svg.hashsalt": "avtorch"}):
        # no ground of its own: the page's paper shows through
        figure.savefig(
            stream, format="svg", transparent=True, metadata=dict.fromkeys(("Date", "Creator", "Format", "Type"))
        )
    text = stream.getvalue()
    text = text[text.index("<svg") :]  # the prologue has no place inside a page
    view = re.search(r'viewBox="[^"]*"', text)
    assert view is not None, "matplotlib writes the extent of every SVG"
    text = text[text.index(">") + 1 :]
    # a style inside a picture would be the whole page's; the page has its own
    text = re.sub(r"<metadata>.*?</metadata>|<style.*?</style>|<!--.*?-->", "", text, flags=re.DOTALL)
    text = re.sub(r'(\bid="|url\(#|href="#)', rf"\g<1>{name}-", text)
    text = re.sub(r"((?:fill|stroke): )(#[0-9a-f]{6})", lambda m: m[1] + _VARIABLES.get(m[2], m[2]), text)
    # hundredths of a point are finer than any screen
    text = re.sub(r'\b(?:d|transform|x|y|width|height)="[^"]*"', _rounded, text)
    text = re.sub(r"\n\s*", "\n", text)
    # matplotlib escapes what it writes
    opening = Markup('<svg class="picture" role="img" aria-label="{}" {}>').format(printable(says), Markup(view[0]))
    return opening + Markup(text)


def _rounded(attribute: re.Match[str]) -> str:
    return re.sub(r"-?\d+\.\d{3,}", lambda m: f"{float(m[0]):.2f}".rstrip("0").rstrip("."), attribute[0])
