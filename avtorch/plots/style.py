"""The style of every picture, and how one is saved or displayed.

One palette (Okabe and Ito's, safe for colour-blind readers) and one meaning a colour: blue is avtorch's belief or
action, vermillion is the run without it, black is the truth, green an action, orange an alert.
"""

from __future__ import annotations

import io
import os
import re
from collections.abc import Callable, Iterable, Sequence
from functools import wraps
from pathlib import Path
from typing import Any, ParamSpec

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, FigureBase
from matplotlib.patches import StepPatch

from avtorch.arrays import FloatArray
from avtorch.display.frame import notebook_display
from avtorch.io import atomic

BLUE, VERMILLION, GREEN, ORANGE, SKY, PURPLE = "#0072B2", "#D55E00", "#009E73", "#E69F00", "#56B4E9", "#A6407E"
BLACK, GREY = "#222222", "#7F7F7F"
UNSTABLE, AMPLIFIES, STABLE = "#DDD3D8", "#FBE6C4", "#D3E8F2"

STYLE: Any = {
    "figure.dpi": 100,
    "savefig.dpi": 150,
    "font.size": 10,
    "axes.titlesize": 11,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": GREY,
    "axes.labelcolor": BLACK,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#E6E6E6",
    "grid.linewidth": 0.7,
    "lines.linewidth": 1.5,
    "lines.solid_capstyle": "round",
    "legend.frameon": False,
    "legend.fontsize": 9,
    "xtick.color": GREY,
    "ytick.color": GREY,
    "xtick.labelcolor": BLACK,
    "ytick.labelcolor": BLACK,
    "hatch.linewidth": 0.6,
}
"""The style of all pictures, as matplotlib's rcParams.

Example:
    >>> import matplotlib
    >>> from avtorch.plots import STYLE
    >>> with matplotlib.rc_context(STYLE):
    ...     print(matplotlib.rcParams["font.size"])
    10.0
"""

LABELS = {
    "T_L": "actuation lag $T_L$ [s]",
    "K_L": "actuation gain $K_L$ [-]",
    "T": "actuation lag $T_L$ [s]",
    "K": "actuation gain $K_L$ [-]",
    "sigma": r"jerk noise $\sigma$ [m/s³]",
    "process_noise": "actuator noise [m/s²/√s]",
    "accel_noise": "accel noise [m/s²]",
    "speed_noise": "speed noise [m/s]",
    "road_noise": "road noise [m/s/√s]",
    "coloured_sd": "coloured force, SD [m/s²]",
    "coloured_time": "coloured force, time [s]",
    "tau": r"time gap $\tau$ [s]",
    "k_s": "spacing gain $k_s$ [1/s²]",
    "k_v": "speed gain $k_v$ [1/s]",
    "k_a": "acceleration gain $k_a$ [-]",
    "speed": "speed [m/s]",
    "accel": "acceleration [m/s²]",
    "spacing": "spacing [m]",
}

SHORT = {
    "T_L": "$T_L$",
    "K_L": "$K_L$",
    "sigma": r"$\sigma$",
    "log_likelihood": "log likelihood",
    "log_posterior": "log posterior",
}

P = ParamSpec("P")

WIDE = 8.6
"""Width of a page's figures [in]."""


def panels_of(count: int, height: float, *, wide: float = WIDE) -> tuple[Figure, list[Axes]]:
    """Panels of that height [in] side by side."""
    figure = Figure(figsize=(wide, height), layout="constrained")
    return figure, list(figure.subplots(1, count, squeeze=False)[0])


def legend(
    figure: FigureBase,
    panels: Iterable[Axes],
    *,
    where: str = "upper left",
    columns: int = 6,
    last: Sequence[str] = (),
    **look: Any,
) -> None:
    """One legend for all panels outside of them, each label once, those of `last` behind the others."""
    handles: dict[str, Any] = {}
    for ax in panels:
        for handle, label in zip(*ax.get_legend_handles_labels(), strict=True):
            handles.setdefault(label, handle)
    names = sorted(handles, key=lambda name: last.index(name) + 1 if name in last else 0)
    count = max(1, min(columns, len(names)))
    place: Any = f"outside {where}"
    figure.legend([handles[name] for name in names], names, loc=place, ncols=count, **look)


def short(name: str) -> str:
    """A quantity's name for a heading, without its unit."""
    return SHORT.get(name, name.replace("_", " "))


def styled(draw: Callable[P, Figure]) -> Callable[P, Figure]:
    """Make a figure in this style without changing the caller's."""

    @wraps(draw)
    def inner(*args: P.args, **kwargs: P.kwargs) -> Figure:
        with mpl.rc_context(STYLE):
            return draw(*args, **kwargs)

    return inner


def save(figure: Figure, path: str | os.PathLike[str]) -> Path:
    """Write a figure as PNG, whole or not at all.

    Example:
        >>> from matplotlib.figure import Figure
        >>> from avtorch.plots import save
        >>> save(Figure(figsize=(1, 1)), "empty.png").read_bytes()[1:4]
        b'PNG'
    """
    picture = _png(figure)
    with atomic(path, binary=True) as stream:
        stream.write(picture)
    return Path(path)


def show(figure: Figure, path: str | os.PathLike[str]) -> None:
    """Display a figure below the cell in a notebook; elsewhere save it at `path` and print the path.

    Raises `InputError` where the file cannot be written.

    Example:
        >>> from matplotlib.figure import Figure
        >>> from avtorch.plots import show
        >>> show(Figure(figsize=(1, 1)), "empty.png")  # in a notebook the picture itself
        picture: empty.png
    """
    display = notebook_display()
    if display is None:
        print(f"picture: {save(figure, path)}")
        return
    # the file's pixels at the figure's size, so that it is sharp on any screen
    width = round(figure.get_figwidth() * STYLE["figure.dpi"])
    display.display(display.Image(_png(figure), width=width, alt=words_of(figure)))


def words_of(figure: Figure) -> str:
    """What is drawn over what, for readers who do not see it: titles, labels and legends of the axes, and how far each
    line goes."""
    parts = []
    for ax in figure.axes:
        # an axes that shares its label has none of its own
        over = [text for text in (ax.get_ylabel(), ax.get_xlabel()) if text]
        what = ": ".join(text for text in (ax.get_title(loc="left") or ax.get_title(), " over ".join(over)) if text)
        lines = lines_of(ax)
        names = [
            f"{label} {np.nanmin(lines[label][:, 1]):.3g} to {np.nanmax(lines[label][:, 1]):.3g}"
            if label in lines and np.isfinite(lines[label][:, 1]).any()
            else label
            for label in dict.fromkeys(ax.get_legend_handles_labels()[1])
        ]
        if what:
            parts.append(" ".join(f"{what}{', with ' if names else ''}{', '.join(names)}.".split()))
    # as words, not as formulas
    return re.sub(r"[$\\{}]", "", " ".join(["Figure.", *parts]))


def lines_of(ax: Axes) -> dict[str, FloatArray]:
    """The lines and stairs of an axes by their labels, each (point, 2), without those that only mark a place."""
    lines = {str(line.get_label()): np.asarray(line.get_xydata(), float) for line in ax.lines}
    for stairs in (patch for patch in ax.patches if isinstance(patch, StepPatch)):
        height, edges, _ = stairs.get_data()
        lines[str(stairs.get_label())] = np.column_stack([0.5 * (edges[1:] + edges[:-1]), height])
    return {label: points for label, points in lines.items() if label[:1] != "_" and len(points) > 2}


def _png(figure: Figure) -> bytes:
    buffer = io.BytesIO()
    with mpl.rc_context(STYLE):
        figure.savefig(buffer, format="png")
    return buffer.getvalue()
