"""What the script of a page must know to read the lines of a picture: where its panels lie and what their axes mean."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from avtorch.arrays import FloatArray, IntArray

_LEAST = 8  # points of a line that is worth reading; rules and markers have fewer
_ROWS = 3000  # of a line, at most, that can be seen when a part is made larger
_LEVELS = 4096  # of a value in two letters
_LETTERS = "ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/"
_GREEK = {r"\tau": "τ", r"\sigma": "σ", r"\omega": "ω"}


@dataclass(frozen=True)
class Rows:
    """What was drawn in an overview, row by row, for who makes a part of it larger.

    `along` (row,) rises within each `stretch` (row,); `panels`: of each panel the values (row,) by the line's label.

    Example:
        >>> import numpy as np
        >>> from avtorch.report.curves import Rows
        >>> rows = Rows(np.arange(3.0), np.zeros(3, int), ({"speed": np.arange(3.0)},))
        >>> rows.runs(), len(rows.letters(0, "speed", 0.0, 2.0))
        ([[0.0, 1.0, 3]], 6)
    """

    along: FloatArray
    stretch: IntArray
    panels: Sequence[Mapping[str, FloatArray]] = field(repr=False)

    def runs(self) -> list[list[float]]:
        """Of each stretch its first time, its step and the number of its means."""
        found = []
        for part in self._parts():
            t = _means(self.along[part], self._every)
            # the last mean may be of fewer rows
            step = float(np.median(np.diff(t))) if len(t) > 1 else 0.0
            found.append([round(float(t[0]), 3), round(step, 6), len(t)])
        return found

    def letters(self, panel: int, label: str, low: float, high: float) -> str:
        """A line's means, each as two letters of base 64 that count 4096 levels from `low` to `high`."""
        values = np.concatenate([_means(self.panels[panel][label][part], self._every) for part in self._parts()])
        level = np.rint((np.nan_to_num(values) - low) / (high - low) * (_LEVELS - 1)).clip(0, _LEVELS - 1).astype(int)
        return "".join(_LETTERS[i // 64] + _LETTERS[i % 64] for i in level.tolist())

    @property
    def _every(self) -> int:
        return -(-len(self.along) // _ROWS)

    def _parts(self) -> list[IntArray]:
        return np.split(np.arange(len(self.along)), np.flatnonzero(np.diff(self.stretch)) + 1)


def _means(values: FloatArray, every: int) -> FloatArray:
    return np.add.reduceat(values, np.arange(0, len(values), every)) / np.diff(
        [*range(0, len(values), every), len(values)]
    )


def named_lines(figure: Figure) -> dict[Axes, list[Line2D]]:
    """The lines that can be read, by panel; their groups in SVG get ids by which the script finds them."""
    found: dict[Axes, list[Line2D]] = {}
    for k, ax in enumerate(figure.axes):
        lines = [line for line in ax.lines if _readable(ax, line)]
        if not lines:
            continue
        ax.set_gid(f"panel-{k}")
        for i, line in enumerate(lines):
            line.set_gid(f"line-{k}-{i}")
        found[ax] = lines
    return found


def curves_json(figure: Figure, lines: Mapping[Axes, Sequence[Line2D]], name: str, rows: Rows | None = None) -> str:
    """The panels of a drawn figure for the script, in the units of its SVG; `name` begins the ids.

    Each has its `box` (left, top, right, bottom), the ends and kinds of its axes, and its lines by id and label.
    """
    width, height = 72 * figure.get_size_inches()
    panels = []
    for k, (ax, some) in enumerate(lines.items()):
        place = ax.get_position()
        box = [place.x0 * width, (1 - place.y1) * height, place.x1 * width, (1 - place.y0) * height]
        y = [float(v) for v in ax.get_ylim()]
        each: list[dict[str, Any]] = []
        for line in some:
            label = str(line.get_label())
            entry = {"id": f"{name}-{line.get_gid()}", "label": _plain(label)}
            if rows is not None and k < len(rows.panels) and label in rows.panels[k]:
                entry["rows"] = rows.letters(k, label, *y)
            each.append(entry)
        panels.append(
            {
                "id": f"{name}-{ax.get_gid()}",
                "box": [round(float(v), 2) for v in box],
                "x": [float(f"{v:.9g}") for v in ax.get_xlim()],
                "y": [float(f"{v:.6g}") for v in y],
                "log": [int(scale == "log") for scale in (ax.get_xscale(), ax.get_yscale())],
                "along": _plain(_label(ax)),
                "of": _plain(ax.get_ylabel()),
                "lines": each,
            }
        )
    told: dict[str, Any] = {"panels": panels}
    if rows is not None:
        told["runs"] = rows.runs()
    return json.dumps(told, ensure_ascii=False, separators=(",", ":"))


def _readable(ax: Axes, line: Line2D) -> bool:
    """Whether it is a line over its panel's axis, from left to right, and not a rule or a cloud of markers."""
    x = np.asarray(line.get_xdata(orig=False), float)
    x = x[np.isfinite(x)]
    drawn = line.get_visible() and line.get_linestyle() not in ("None", "none", " ", "")
    scales = {ax.get_xscale(), ax.get_yscale()} <= {"linear", "log"}
    named = not str(line.get_label()).startswith("_") or len(ax.lines) == 1
    return bool(drawn and scales and named and len(x) >= _LEAST and (np.diff(x) >= 0).all() and x[-1] > x[0])


def _label(ax: Axes) -> str:
    """What its horizontal axis is called, under it or under the panel that shares the axis."""
    return next((x.get_xlabel() for x in (ax, *ax.get_shared_x_axes().get_siblings(ax)) if x.get_xlabel()), "")


def _plain(text: str) -> str:
    """A label without the marks of mathematical type."""
    if text.startswith("_"):
        return ""
    for command, letter in _GREEK.items():
        text = text.replace(command, letter)
    return re.sub(r"[${}]", "", text)
