"""Logs whose command is no acceleration: a map makes one of their pedals before anything else is done."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from avtorch.cli.talk import Talk

if TYPE_CHECKING:
    from avtorch.arrays import FloatArray
    from avtorch.io import Log
    from avtorch.pedals import PedalFit, PedalTable


def commanded(talk: Talk, drives: Sequence[Log]) -> tuple[list[Log], PedalFit | None, str]:
    """The drives with an `accel_cmd`, the fit of the map that made it, and a sentence on it.

    Drives of which one has an `accel_cmd`, or neither pedals nor a `speed_cmd`, are returned as they are, with None
    and "".
    """
    if any(drive.accel_cmd is not None or (not drive.pedals and drive.speed_cmd is None) for drive in drives):
        return list(drives), None, ""
    from avtorch.pedals import fit_pedals

    with talk.waiting("Fitting a map of the commands"):
        fit = fit_pedals(drives)
        sentence = map_sentence(fit)
    talk.lines([sentence, ""])
    return [fit.map.commanded(drive) for drive in drives], fit, sentence


def map_sentence(fit: PedalFit) -> str:
    """What stands for the command, how good it is, and what it cannot tell."""
    made, score = fit.map, fit.held_out
    slowest, fastest = made.driven or (made.speed[0], made.speed[-1])
    at_others = "is held" if "speed_error" in made.pedals else "goes on along a line"
    ranges = [f"{name} {_range(name, table.pedal)}" for name, table in made.pedals.items()]
    worth = "better" if score.better_than("factor") else "not surely better"
    names = " and ".join(made.pedals)
    said = (
        f"The log has no accel_cmd: a map of {names} and speed stands for it ({', '.join(ranges)}, speed "
        f"{slowest:.3g} to {fastest:.3g} m/s; at others it {at_others}). On blocks left out its free runs of "
        f"{score.horizon_s:.2g} s miss speed by {score.rmse('map'):.2g} m/s, one constant factor by "
        f"{score.rmse('factor'):.2g} m/s: {worth}. "
        "The map and K_L cannot be told apart: K_L is 1 by the map's scale."
    )
    if "speed_error" not in made.pedals:
        return said
    return (
        f"{said} The command answers to the measured speed, and so to its noise: 0.1 m/s move it by "
        f"{0.1 * _steepest(made.pedals['speed_error']):.2g} m/s²."
    )


def _steepest(table: PedalTable) -> float:
    """The steepest slope [1/s] of what a speed error adds, in the intervals beside zero."""
    import numpy as np

    slopes = np.diff(table.accel, axis=0) / np.diff(table.pedal)[:, None]
    beside = (table.pedal[:-1] <= 0) & (table.pedal[1:] >= 0)
    return float(slopes[beside].max())


def _range(name: str, knots: FloatArray) -> str:
    from avtorch.plots.pedals import shown_unit

    low, high = float(knots[0]), float(knots[-1])
    size, unit = shown_unit(name, high)
    return f"{size * low:.3g} to {size * high:.3g} {unit}"


def write_pedals(fit: PedalFit | None, staged: Path) -> None:
    """Write the map, its tables for other tools and its picture into the folder of an answer set; nothing without one.

    Raises `InputError` where that cannot be done.
    """
    if fit is None:
        return
    from avtorch import plots
    from avtorch.pedals import write_map

    write_map(fit.map, staged)
    plots.save(plots.pedal_figure(fit.map), staged / "pedal_map.png")
