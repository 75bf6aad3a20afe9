"""The same drawing in fewer letters: paths by their steps, short styles, no ids that nothing refers to."""

from __future__ import annotations

import re

_LETTERS = "DejaVu Sans, Verdana, sans-serif"
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
    text = re.sub(r'\bd="([^"]*)"', lambda m: f'd="{_path(m[1])}"', text)
    text = re.sub(r'\b(?:transform|x|y|width|height)="[^"]*"', _rounded, text)
    met = set(re.findall(r'(?:url\(#|href="#)([^")]+)', text))
    text = re.sub(r' id="([^"]*)"', lambda m: _named(m[1], met), text)
    text = re.sub(r'\bstyle="([^"]*)"', lambda m: f'style="{_style(m[1])}"', text)
    return re.sub(r"\n\s*", "\n", text).replace("<g>\n", "<g>").replace("\n</g>", "</g>")


def _path(path: str) -> str:
    """Straight lines by steps from point to point; rounded before the steps are taken, so that no error adds up."""
    tokens = path.split()
    if set(re.findall("[A-Za-z]", path)) - set("MLz"):
        return re.sub(r" ?([A-Za-z]) ?", r"\1", _rounded_text(" ".join(tokens)))
    words, at, drawing, i = [], (0, 0), False, 0
    while i < len(tokens):
        command = tokens[i]
        if command == "z":
            words.append("z")
            drawing, i = False, i + 1
            continue
        x, y = (round(100 * float(v)) for v in tokens[i + 1 : i + 3])
        if command == "M":
            words.append(f"M{_joined(x, y)}")
        else:
            step = _joined(x - at[0], y - at[1])
            words.append(("" if step[0] == "-" else " ") + step if drawing else f"l{step}")
        drawing, at, i = command == "L", (x, y), i + 3
    return "".join(words)


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


def _named(name: str, met: set[str]) -> str:
    """An id that is needed, or a class in its place, or nothing."""
    if name in met or _KEPT.search(name):
        return f' id="{name}"'
    tick = re.search(r"(?:^|-)([xy]tick)_\d+$", name)
    return f' class="{tick[1]}"' if tick else ""


def _style(style: str) -> str:
    style = re.sub(r"(font: [^;]*?px )[^;]*", rf"\g<1>{_LETTERS}", style)
    style = re.sub(r"(font-family: )[^;]*", rf"\g<1>{_LETTERS}", style)
    return re.sub(r"([:;,]) ", r"\1", style)
