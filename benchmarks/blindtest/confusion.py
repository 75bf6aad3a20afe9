"""Drawings of verdicts: true causes against the answers."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from avtorch.errors import InputError
from avtorch.gap import EFFECTS, PLACES
from avtorch.plots.style import BLACK, BLUE, GREY, VERMILLION, styled

SEVERAL, OTHERS = "several causes", "other causes"
_SHADES = LinearSegmentedColormap.from_list("right", ["#FFFFFF", BLUE])
_WRONG = LinearSegmentedColormap.from_list("wrong", ["#FFFFFF", VERMILLION])

Counts = Mapping[str, Mapping[str, int]]


def confusion(ax: Axes, counts: Counts) -> Axes:
    """The confusion matrix, a row a truth and a column a verdict, effects in the order of the chain.

    Colour is the share of the row, blue where the verdict is right, vermillion where it is not; the number is the count
    of cases. Truths of two or more causes make one row, `several causes`. A verdict of two or more names counts as
    `several causes` where it names exactly the true ones, as `other causes` elsewhere. Labels that occur nowhere are
    left out.

    Args:
        counts: `{truth: {verdict: count}}`, as `confusion` of `blindtest.json`.

    Raises:
        InputError: where there is no case.

    Example:
        >>> from matplotlib.figure import Figure
        >>> from benchmarks.blindtest.confusion import confusion
        >>> counts = {"none": {"none": 9, "dead_time": 1}, "dead_time": {"dead_time": 5}}
        >>> ax = confusion(Figure().subplots(), counts)
        >>> [text.get_text() for text in ax.texts]
        ['9', '1', '5']
    """
    gathered = _gathered(counts)
    rows = [name for name in _order() if sum(gathered.get(name, {}).values())]
    if not rows:
        raise InputError("counts: found no case, needs one")
    verdicts = {verdict for row in gathered.values() for verdict in row}
    columns = [name for name in _order() if name in verdicts or name in rows]
    table = np.array([[gathered[row][column] for column in columns] for row in rows], float)
    share = table / table.sum(1, keepdims=True)
    for i, row in enumerate(rows):
        for j, column in enumerate(columns):
            right = row == column
            if right:
                ax.add_patch(Rectangle((j - 0.5, i - 0.5), 1, 1, fill=False, edgecolor=GREY, linewidth=0.8, zorder=3))
            if not table[i, j]:
                continue
            colour = (_SHADES if right else _WRONG)(share[i, j])
            ax.add_patch(Rectangle((j - 0.5, i - 0.5), 1, 1, facecolor=colour, linewidth=0, zorder=1))
            dark = share[i, j] > 0.55
            count = f"{table[i, j]:.0f}"
            ax.text(j, i, count, ha="center", va="center", fontsize=7, color="white" if dark else BLACK, zorder=4)
    places = [_place(name) for name in rows], [_place(name) for name in columns]
    for k in range(1, len(rows)):
        if places[0][k] != places[0][k - 1]:
            ax.axhline(k - 0.5, color=GREY, linewidth=0.6, zorder=2)
    for k in range(1, len(columns)):
        if places[1][k] != places[1][k - 1]:
            ax.axvline(k - 0.5, color=GREY, linewidth=0.6, zorder=2)
    ax.set_xlim(-0.5, len(columns) - 0.5)
    ax.set_ylim(len(rows) - 0.5, -0.5)
    ax.set_xticks(range(len(columns)), [_words(name) for name in columns], rotation=60, ha="right", fontsize=8)
    ax.set_yticks(
        range(len(rows)), [f"{_words(r)}  ({n:.0f})" for r, n in zip(rows, table.sum(1), strict=True)], fontsize=8
    )
    for label in ax.get_xticklabels():
        label.set_rotation_mode("anchor")
    ax.tick_params(length=0)
    ax.grid(False)
    ax.spines[:].set_visible(False)
    ax.set_xlabel("verdict")
    ax.set_ylabel("truth (cases)")
    return ax


@styled
def confusion_figure(answer: Mapping[str, Any]) -> Figure:
    """The confusion matrix of `blindtest.json`.

    Example:
        >>> from benchmarks.blindtest.confusion import confusion_figure
        >>> counts = {"none": {"none": 9, "dead_time": 1}, "dead_time": {"dead_time": 5}}
        >>> answer = {"confusion": counts, "cases": 15, "answerer": "avtorch", "signals": ["accel", "speed"]}
        >>> len(confusion_figure(answer).axes) > 0
        True
    """
    gathered = _gathered(answer["confusion"])
    labels = {verdict for row in gathered.values() for verdict in row} | gathered.keys()
    size = 0.31 * len(labels)
    figure = Figure(figsize=(max(size + 2.6, 5.0), max(size + 2.0, 3.6)), layout="constrained")
    ax = confusion(figure.subplots(), answer["confusion"])
    right = sum(count.get(truth, 0) for truth, count in answer["confusion"].items())
    signals = " and ".join(answer.get("signals", ())) or "all signals"
    ax.set_title(
        f"{right} of {answer['cases']} sealed cases right\n{answer.get('answerer', 'verdicts')}, {signals}", fontsize=10
    )
    return figure


def _gathered(counts: Counts) -> dict[str, Counter[str]]:
    """With sets of two or more put together."""
    out: dict[str, Counter[str]] = {}
    for truth, verdicts in counts.items():
        row = out.setdefault(SEVERAL if "+" in truth else truth, Counter())
        for verdict, count in verdicts.items():
            named = verdict if "+" not in verdict else SEVERAL if verdict == truth else OTHERS
            row[named] += count
    return out


def _order() -> list[str]:
    effects = sorted(EFFECTS, key=lambda name: (PLACES.index(EFFECTS[name].place), name))
    return ["none", *effects, SEVERAL, OTHERS, "unknown", "failed"]


def _place(name: str) -> str:
    return EFFECTS[name].place if name in EFFECTS else name if name in ("none", "unknown", "failed") else "several"


def _words(name: str) -> str:
    return {"unknown": "outside the table", "failed": "no answer"}.get(name, name.replace("_", " "))
