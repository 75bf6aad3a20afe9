"""Drawings of a map of pedals."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from avtorch.pedals.pedal_map import PedalMap, unit_of
from avtorch.plots.style import BLACK, BLUE, GREEN, GREY, ORANGE, VERMILLION, styled

_COLOURS = (VERMILLION, ORANGE, GREEN, BLUE, BLACK)
_LINES = 4  # speeds


def shown_unit(name: str, largest: float) -> tuple[float, str]:
    """What a pedal's values are multiplied by to be shown, and the unit then; a brake's is by its largest value."""
    unit = unit_of(name, largest)
    return {"-": (100.0, "%"), "Pa": (1e-5, "bar")}.get(unit, (1.0, unit.replace("2", "²")))


@styled
def pedal_figure(made: PedalMap) -> Figure:
    """The acceleration that each pedal demands, the others at rest; likewise a commanded speed's error, and its slope.

    Lines are at some speeds between the slowest and the fastest that were driven; bands are one standard error, by
    blocks of the drive, of what the pedal adds.

    Example:
        >>> import numpy as np
        >>> from avtorch.pedals import PedalMap, PedalTable
        >>> from avtorch.plots import pedal_figure
        >>> throttle = PedalTable(np.array([0.0, 0.1, 1.0]), np.array([[0, 0], [0, 0], [4.0, 2.0]]))
        >>> made = PedalMap(np.array([0.0, 30.0]), np.array([0.0, -0.6]), {"throttle": throttle})
        >>> len(pedal_figure(made).axes)
        1
    """
    count = len(made.pedals)
    figure = Figure(figsize=(1.5 + 4.2 * count, 3.8), layout="constrained")
    low, high = made.driven or (made.speed[0], made.speed[-1])
    driven = np.flatnonzero((made.speed >= low) & (made.speed <= high))
    rows = np.unique(driven[np.linspace(0, len(driven) - 1, _LINES).round().astype(int)])
    for ax, (pedal, table) in zip(figure.subplots(1, count, squeeze=False)[0], made.pedals.items(), strict=True):
        scale, unit = shown_unit(pedal, float(np.abs(table.pedal).max()))
        for colour, row in zip(_COLOURS, rows, strict=False):
            level = made.coasting[row] + table.accel[:, row]
            ax.plot(scale * table.pedal, level, color=colour, marker=".", label=f"{made.speed[row]:.3g} m/s")
            if table.sd is not None:
                ends = level - table.sd[:, row], level + table.sd[:, row]
                ax.fill_between(scale * table.pedal, *ends, color=colour, alpha=0.15, linewidth=0)
        ax.axhline(0.0, color=GREY, linestyle=":", linewidth=1)
        ax.set(xlabel=f"{pedal} [{unit}]", ylabel="acceleration demanded [m/s²]", title=pedal)
        ax.legend(loc="best")
    return figure
