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
from avtorch.report.compact import compact
from avtorch.report.curves import Rows, curves_json, named_lines
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
    "#D5D5D5": "p-fill",  # a band of ranks
    "#DADADA": "p-fill",  # an exact density
    "#555555": "soft",  # its outline
    "#E6E6E6": "p-grid",
}
"""Colours of the drawings by the style's name for them."""

_PX_A_POINT = 1.5
_VARIABLES = {colour.lower(): f"var(--{name})" for colour, name in _COLOURS.items()}


@dataclass(frozen=True)
class Picture:
    """A picture as `wide` and `narrow` SVG, for a desk and for a phone; `narrow` is empty where one serves both.

    `says`: what it shows, in words; `caption`; `tables`: its numbers, shown at once where `opened`.

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
    name: str,
    draw: Callable[[bool], Figure],
    says: str,
    *tables: Table,
    caption: str = "",
    opened: bool = False,
    rows: Rows | None = None,
) -> Picture:
    """What `draw` makes of False, for a desk, and of True, for a phone; `rows`: finer than the drawing.

    Example:
        >>> from matplotlib.figure import Figure
        >>> from avtorch.report.picture import picture_of
        >>> picture_of("empty", lambda narrow: Figure(figsize=(1, 1)), "Nothing.").says
        'Nothing.'
    """
    # one copy of the rows serves both
    wide = inline_svg(f"{name}-wide", draw(False), says, rows)
    narrow = inline_svg(f"{name}-narrow", draw(True), says)
    return Picture(wide, narrow, says, caption, tables, opened)


def small_picture(name: str, figure: Figure, says: str, *tables: Table, caption: str = "") -> Picture:
    """A figure as wide as a phone, beside another on a desk.

    Example:
        >>> from matplotlib.figure import Figure
        >>> from avtorch.report.picture import small_picture
        >>> small_picture("empty", Figure(figsize=(1, 1)), "Nothing.").narrow
        Markup('')
    """
    return Picture(inline_svg(name, figure, says), Markup(""), says, caption, tables)


def inline_svg(name: str, figure: Figure, says: str, rows: Rows | None = None) -> Markup:
    """A figure as SVG for the page: text as text, no date, equal for equal figures.

    `name` begins its ids and is the page's only one; `says` is its text alternative. A colour of the house's palette
    becomes the style's variable. Lines can be read and made larger where the page runs its script, by `rows` where
    these are given.

    Example:
        >>> from matplotlib.figure import Figure
        >>> from avtorch.report.picture import inline_svg
        >>> inline_svg("empty", Figure(figsize=(1, 1)), "Nothing.")[:56]
        Markup('<svg class="picture" role="img" aria-label="Nothing." vi')
    """
    stream = io.StringIO()
    lines = named_lines(figure)
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
    opening = Markup('<svg class="picture" role="img" aria-label="{}" {}').format(printable(says), Markup(view[0]))
    if lines:
        told = printable(curves_json(figure, lines, name, rows))
        # JSON is full of quotation marks
        for letter, escaped in (("&", "&amp;"), ("<", "&lt;"), (">", "&gt;"), ("'", "&#39;")):
            told = told.replace(letter, escaped)
        opening += Markup(f" data-curves='{told}'")
    # letters are of one size on a desk, whatever the width of the figure
    opening += Markup(' style="max-width: {}px">').format(round(_PX_A_POINT * 72 * figure.get_figwidth()))
    # matplotlib escapes what it writes
    return opening + Markup(compact(text))
