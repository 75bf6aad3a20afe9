"""The same drawing in fewer letters: paths by their steps, short styles, no ids that nothing refers to, no point within
a straight line along an axis."""

from __future__ import annotations

import re
from collections.abc import Mapping

_MARKERS = re.compile(r"<g([^>]*)>\n?((?:<use [^>]*/>\n){2,})</g>")
_KEPT = re.compile(r"panel-|line-\d+-")
"""Ids that the script of the page looks for."""


def compact(text: str) -> str:
    """An SVG by matplotlib, smaller: it draws the same to a hundredth of a point.

    Groups of ticks keep their kind as a class, `xtick` or `ytick`, for the script that draws others.

    Example:
        >>> from avtorch.report.compact import compact
        >>> compact('<g id="xtick_1"><path d="M 1.004 2 L 3 2.5 L 4 2 " style="fill: none; stroke: red"/></g>')
        '<g class="xtick"><path d="M1 2l2 .5 1-.5" style="fill:none;stroke:red"/></g>'
    """
    text = re.sub(r' transform="rotate\(-?0 [^"]*\)"', "", text)
    text = re.sub(r'\bd="([^"]*)"', lambda m: f'd="{_path(m[1])}"', text)
    text = re.sub(r'\b(?:transform|x|y|width|height)="[^"]*"', _rounded, text)
    # what is drawn by a name gets a short one, after the picture's
    met = {name: i for i, name in enumerate(dict.fromkeys(re.findall(r'(?:url\(#|href="#)([^")]+)', text)))}
    text = re.sub(r'(url\(#|href="#)([^")]+)', lambda m: m[1] + _short(m[2], met), text)
    text = re.sub(r' id="([^"]*)"', lambda m: _named(m[1], met), text)
    text = re.sub(r' style="([^"]*)"', lambda m: _style(m[1]), text)
    # a mark of an axis has its style where it is defined
    text = re.sub(r'(<use [^>]*?) style="fill:var\(--p-grey\);stroke:var\(--p-grey\);stroke-width:0.8"', r"\1", text)
    text = _MARKERS.sub(_shared, re.sub(r"\n\s*", "\n", text))
    text = text.replace("<g>\n", "<g>").replace("\n</g>", "</g>")
    # a browser would give the space between two letters a size of its own
    return text.replace("\n<tspan", "<tspan").replace("</tspan>\n", "</tspan>")


def _path(path: str) -> str:
    """Straight lines by steps from point to point; rounded before the steps are taken, so that no error adds up."""
    tokens = path.split()
    if set(re.findall("[A-Za-z]", path)) - set("MLz"):
        return re.sub(r" ?([A-Za-z]) ?", r"\1", _rounded_text(" ".join(tokens)))
    words, at, drawing = [], (0, 0), False
    for command, point in _straightened(tokens):
        if command == "z":
            words.append("z")
        elif command == "M":
            words.append(f"M{_joined(*point)}")
        else:
            step = _joined(point[0] - at[0], point[1] - at[1])
            words.append(("" if step[0] == "-" else " ") + step if drawing else f"l{step}")
        drawing, at = command == "L", at if command == "z" else point
    return "".join(words)


def _straightened(tokens: list[str]) -> list[tuple[str, tuple[int, int]]]:
    """Commands with their points in hundredths, without what repeats a point and what lies between two others on a line
    along an axis: outlines of areas on a grid are full of them."""
    kept: list[tuple[str, tuple[int, int]]] = []
    i = 0
    while i < len(tokens):
        if tokens[i] == "z":
            kept.append(("z", (0, 0)))
            i += 1
            continue
        x, y = (round(100 * float(v)) for v in tokens[i + 1 : i + 3])
        if tokens[i] == "L":
            while (
                len(kept) > 1
                and kept[-1][0] == "L"
                and kept[-2][0] != "z"
                and _within(kept[-2][1], kept[-1][1], (x, y))
            ):
                kept.pop()
        kept.append((tokens[i], (x, y)))
        i += 3
    return kept


def _within(a: tuple[int, int], b: tuple[int, int], c: tuple[int, int]) -> bool:
    """Whether b lies between the others on a line along an axis: where the line turns back it ends in a spike."""
    if a[0] == b[0] == c[0]:
        return a[1] <= b[1] <= c[1] or a[1] >= b[1] >= c[1]
    return a[1] == b[1] == c[1] and (a[0] <= b[0] <= c[0] or a[0] >= b[0] >= c[0])


def _shared(group: re.Match[str]) -> str:
    """What all markers of a group look like is said once, by the group."""
    styles = set(re.findall(r' style="[^"]*"', group[2]))
    if len(styles) != 1 or "style=" in group[1]:
        return group[0]
    (style,) = styles
    return f"<g{group[1]}{style}>\n{group[2].replace(style, '')}</g>"


def _joined(x: int, y: int) -> str:
    """Two numbers in hundredths, parted by no more than needed."""
    first, second = _number(x), _number(y)
    return first + ("" if second[0] == "-" else " ") + second


def _number(hundredths: int) -> str:
    text = f"{hundredths / 100:.2f}".rstrip("0").rstrip(".")
    return text.replace("0.", ".", 1) if text.startswith(("0.", "-0.")) else text if text != "-0" else "0"


def _rounded(attribute: re.Match[str]) -> str:
    return _rounded_text(attribute[0])


def _rounded_text(text: str) -> str:
    return re.sub(r"-?\d+\.\d{3,}", lambda m: f"{float(m[0]):.2f}".rstrip("0").rstrip("."), text)


def _short(name: str, met: Mapping[str, int]) -> str:
    return f"{name.rpartition('-')[0]}-{met[name]}"


def _named(name: str, met: Mapping[str, int]) -> str:
    """An id that is needed, or a class in its place, or nothing."""
    if name in met:
        return f' id="{_short(name, met)}"'
    if _KEPT.search(name):
        return f' id="{name}"'
    tick = re.search(r"(?:^|-)([xy]tick)_\d+$", name)
    return f' class="{tick[1]}"' if tick else ""


def _style(style: str) -> str:
    """The attribute without what the page's style says of all pictures: the letters, 10 points high, and the ends."""
    style = re.sub(r"font: (\d[\d.]*px) [^;]*", r"font-size: \1", style)
    # the short form of a bold or slanted letter does not hold without a font
    style = re.sub(r"(font: [^;]*?px )[^;]*", r"\g<1>DejaVu Sans, Verdana, sans-serif", style)
    style = re.sub(r"font-family: [^;]*;? ?|font-size: 10px(?:;|$) ?", "", style)
    style = re.sub(r"; stroke-linecap: round|stroke-linejoin: miter;? ?", "", style)
    style = re.sub(r"([:;,]) ", r"\1", style).strip("; ")
    return f' style="{style}"' if style else ""
