"""What each picture of a diagnosis shows: drawn for a desk and for a phone, told in words, and as numbers."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from avtorch.experiment import Experiment
from avtorch.gap.answer.budget import Budget, percent
from avtorch.gap.answer.location import UNITS, Axis
from avtorch.gap.result import sentences
from avtorch.gap.result.diagnosis import Diagnosis, Shrinkage
from avtorch.plots.diagnosis import (
    budget_figure,
    histogram_of,
    road_figure,
    shrinkage_figure,
    stretch_of,
    where_figure,
    which_figure,
)
from avtorch.plots.experiment import experiment_figure
from avtorch.plots.free_form import driven_cells, free_form_figure
from avtorch.plots.whole_drive import DriveTime, drive_figure, drive_panels, drive_time
from avtorch.report.curves import Rows
from avtorch.report.entries import budget_table, candidate_table, measure_table
from avtorch.report.picture import Picture, picture_of
from avtorch.report.table import Table, of_numbers

_MOST = 60  # rows of a table behind a picture of lines
_NOT_COUNTED = {
    "driver": "grey, the driver's hand",
    "standstill": "hatched upwards, standstill",
    "gap": "hatched downwards, no rows",
    "settling": "pale, the first seconds of a drive and after a return",
}
_ALARMS = 6  # named in the words below a picture
_PARTS = 12  # of the drive, rows of its table


def pictures(found: Diagnosis, experiment: Experiment | None = None) -> dict[str, Picture | None]:
    """The pictures of a diagnosis and of the `experiment` to drive next, by name; None where there is nothing to draw.

    Example:
        >>> from avtorch import Leader, diagnose, simulate
        >>> from avtorch.gap import DeadTime, plant
        >>> from avtorch.report.pictures import pictures
        >>> late = plant([DeadTime(0.4)], sigma=0.0)
        >>> log = simulate(Leader.default(start=50.0, duration=14.0, dt=0.1), plant=late).log()
        >>> drawn = pictures(diagnose(log, effects=["dead_time"], pairs=False))
        >>> drawn["which"].says.split(":")[0], drawn["next"]
        ('Bars of the probability of each hypothesis', None)
    """
    return {
        "budget": _budget(found),
        "free_form": _free_form(found),
        "drive": _drive(found),
        "road": _road(found),
        "where": _where(found),
        "which": _which(found),
        "shrinkage": _shrinkage(found),
        "next": None if experiment is None else _next(experiment),
    }


def _budget(found: Diagnosis) -> Picture | None:
    budget = found.budget
    if budget is None:
        return None
    if not budget.parts:
        return _without_parts(found, budget)
    shares = [(part.name, part.share) for part in budget.parts] + [("unexplained", budget.unexplained.share)]
    says = ", ".join(f"{name} {100 * share.mean:.0f} %" for name, share in shares)
    return picture_of(
        "budget",
        lambda narrow: budget_figure(found, narrow=narrow),
        f"Bars of what each effect contributes to the gap: {says}.",
        budget_table(budget, found.log.epochs_s[0]),
        caption=f"A share is what an effect takes off the squared error of {budget.horizon_s:.3g} s simulations, above "
        "that of noise alone, on parts of the drive not used for fitting; effects are added in the order shown. Black "
        "lines: 90 % intervals.",
        opened=True,
    )


def _without_parts(found: Diagnosis, budget: Budget) -> Picture:
    """What the error consists of where no effect takes anything off it."""
    rest = budget.left_above_noise
    counts = ""
    if not budget.unexplained.material:
        counts = (
            " What is unexplained does not count: it is too little, or not sure." if rest else " All of it is noise."
        )
    return picture_of(
        "budget",
        lambda narrow: budget_figure(found, narrow=narrow),
        "Bars of what the error of the baseline simulator consists of: "
        f"unexplained {percent(rest)}, noise {percent(1.0 - rest)}.",
        budget_table(budget, found.log.epochs_s[0]),
        caption=f"Shares of the squared error of {budget.horizon_s:.3g} s simulations by the baseline, on parts of the "
        "drive not used for fitting. Noise is what commands, speed and place do not predict; what is unexplained is "
        f"reproducible, and no known effect reduces it.{counts}",
        opened=True,
    )


def _free_form(found: Diagnosis) -> Picture | None:
    form = found.free_form
    if form is None:
        return None
    u, v = form.knots_u, form.knots_v
    columns, rows, says = ["speed [m/s]"], v[:, None], []
    if form.sizes.table > 0:
        driven = driven_cells(found)[2].mean()
        says.append(
            f"Contours of the force beyond K u over speed, {v[0]:.3g} to {v[-1]:.3g} m/s, and command, {u[0]:.2g} to "
            f"{u[-1]:.2g} m/s²: {form.at.table.min():.2g} to {form.at.table.max():.2g} m/s²; {100 * driven:.0f} % of "
            "the cells were driven."
        )
        columns += [f"force beyond K u at {x:.2g} m/s² [m/s²]" for x in u]
        rows = np.column_stack([rows, form.at.table.T])
    if form.sizes.resistance > 0:
        says.append(f"A line of the resistance: {form.at.curve.min():.2g} to {form.at.curve.max():.2g} m/s².")
        columns.append("resistance [m/s²]")
        rows = np.column_stack([rows, form.at.curve])
    return picture_of(
        "free_form",
        lambda narrow: free_form_figure(found, narrow=narrow),
        " ".join(says),
        of_numbers("What the repaired simulator carries without a name", tuple(columns), rows, (".3g",) * len(columns)),
        caption="What the car's force does beyond the gain and what was named, as the repaired simulator carries it. "
        "Hatched: not driven; there nothing but its smoothness speaks, and far from the drive it goes back to K u. A "
        "dead band, a limit or an asymmetry of the drive may hide in it.",
    )


def _drive(found: Diagnosis) -> Picture | None:
    traces = found.traces
    if traces is None or len(traces.time) < _PARTS:
        return None
    axis = drive_time(found)
    columns = ["part of the drive [s]", "command, least to greatest [m/s²]"]
    for name in traces.channels:
        unit = "m/s²" if name == "accel" else "m/s"
        columns += [f"{name} [{unit}]", f"{name}, error without [{unit}]", f"{name}, error with [{unit}]"]
    rows = []
    rollouts = [traces.begun_anew(x) for x in (traces.before, traces.after)]
    for part in np.array_split(np.arange(len(axis.along)), _PARTS):
        command = traces.command[part]
        cells = [
            f"{axis.along[part[0]]:.0f} to {axis.along[part[-1]]:.0f}",
            f"{command.min():.2f} to {command.max():.2f}",
        ]
        for k in range(len(traces.channels)):
            wholes = (traces.measured[k], *((traces.measured - x)[k] for x in rollouts))
            sizes = [np.std(wholes[0][part]), *(np.sqrt(np.mean(x[part] ** 2)) for x in wholes[1:])]
            cells += [f"{size:.3f}" for size in sizes]
        rows.append(tuple(cells))
    named = " and that with what was named" if found.winner.effects else ""
    return picture_of(
        "drive",
        lambda narrow: drive_figure(found, narrow=narrow),
        f"Lines over the whole drive, {axis.along[0]:.0f} to {axis.along[-1]:.0f} s: the command, the measured "
        f"{' and '.join(traces.channels)}, the baseline simulator{named}.{_marked(axis)}",
        Table("The drive in parts: standard deviation of each signal, RMS of each error", tuple(columns), tuple(rows)),
        caption="Each line shows the least and the greatest value of short intervals. Simulated lines come from the "
        f"logged commands; every ten seconds a speed begins at the measured one.{_marked(axis)}{_fit(found)}",
        rows=Rows(axis.along, traces.piece, [panel.lines for panel in drive_panels(found)]),
    )


def _fit(found: Diagnosis) -> str:
    """How well the rollouts fit, channel by channel."""
    traces = found.traces
    assert traces is not None
    told = []
    for name, before, after in zip(traces.channels, traces.fit(traces.before), traces.fit(traces.after), strict=True):
        if np.isfinite(before):
            word = {"accel": "acceleration"}.get(name, name)
            named = f", {after:.0f} % with it" if found.winner.effects else ""
            told.append(f"{word} {before:.0f} %{' without what was named' if named else ''}{named}")
    if not told:
        return ""
    return f" Fit of the simulated lines (100 % is exact, 0 % no better than the mean): {'; '.join(told)}."


def _marked(axis: DriveTime) -> str:
    told = []
    if axis.uncounted:
        each = [
            f"{words} {sum(x.end - x.begin for x in axis.uncounted if x.why == why):.0f} s"
            for why, words in _NOT_COUNTED.items()
            if any(x.why == why for x in axis.uncounted)
        ]
        told.append(f" Shaded: what did not count ({'; '.join(each)}).")
    if len(axis.begins) > 1:
        told.append(f" {len(axis.begins)} logs, one behind the other.")
    if axis.onset is not None:
        told.append(f" Dashed: the onset, at {axis.onset:.1f} s.")
    if axis.alarms:
        some = [f"{x.detector} at {x.at:.1f} s" for x in axis.alarms[:_ALARMS]]
        more = [f"{len(axis.alarms) - _ALARMS} more"] if len(axis.alarms) > _ALARMS else []
        told.append(f" Dash-dotted: alarms of the monitor ({', '.join([*some, *more])}).")
    return "".join(told)


def _road(found: Diagnosis) -> Picture | None:
    if found.traces is None:
        return None
    stretch = stretch_of(found)
    labels, lines = list(stretch.lines), list(stretch.lines.values())
    errors = [f"{np.sqrt(np.mean((line - lines[0]) ** 2)):.2g}" for line in lines[1:]]
    off = " and ".join(
        f"{error} {_unit(stretch.axis)} {label}" for error, label in zip(errors, labels[1:], strict=True)
    )
    rows = _some(np.column_stack([stretch.time, *lines]))
    table = of_numbers(
        f"The {_quantity(stretch.axis)} in this stretch",
        ("time [s]", *(f"{label} [{_unit(stretch.axis)}]" for label in labels)),
        rows,
        (".2f", *(".3f" for _ in labels)),
    )
    return picture_of(
        "road",
        lambda narrow: road_figure(found, narrow=narrow),
        f"Lines of {_quantity(stretch.axis)} over time, {stretch.time[0]:.0f} to {stretch.time[-1]:.0f} s: "
        f"{', '.join(labels)}. RMS error: {off}.",
        table,
        caption=f"{_which_stretch(found)} Simulated lines: the simulator gets the logged commands and never "
        "the measured acceleration; its speed starts at the measured one.",
    )


def _which_stretch(found: Diagnosis) -> str:
    traces = found.traces
    assert traces is not None
    if (traces.before == traces.after).all():
        return "The beginning of the drive; nothing was named that another stretch would show better."
    return "The stretch of the drive in which the effect is strongest."


def _where(found: Diagnosis) -> Picture | None:
    traces = found.traces
    # where nothing is missing no effect is named whose place could be drawn
    if traces is None or not traces.does.any() or found.verdict.name == "none":
        return None
    axes: list[Axis] = ["time", "command"] if traces.speed is None else ["time", "speed", "command"]
    tables = []
    for axis in axes:
        shares = histogram_of(found, axis, bins=15)
        rows = [
            (f"{a:.3g} to {b:.3g}", f"{100 * drive:.0f} %", f"{100 * effect:.0f} %")
            for a, b, drive, effect in zip(shares.edges, shares.edges[1:], shares.rows, shares.effect, strict=False)
        ]
        columns = (f"{axis} [{UNITS[axis]}]", "share of the drive", "share of the effect")
        tables.append(Table(f"Along {axis}", columns, tuple(rows), numeric=columns[1:]))
    said = " ".join(sentences.where(found)) or "No part of the drive stands out."
    return picture_of(
        "where",
        lambda narrow: where_figure(found, narrow=narrow),
        f"Histograms along {', '.join(axes)}: the share of the drive beside the share of the effect. {said}",
        *tables,
        caption="Where the blue line is above the grey ground, the effect acts more than its share of the drive.",
    )


def _which(found: Diagnosis) -> Picture:
    bars = ", ".join(f"{c.name.replace('+', ' + ')} {sentences.number(c.probability)}" for c in found.candidates[:3])
    return picture_of(
        "which",
        lambda narrow: which_figure(found, narrow=narrow),
        f"Bars of the probability of each hypothesis: {bars}.",
        candidate_table(found),
        caption="Blue, and bold in the table: the alias set, which this log cannot distinguish from the verdict. "
        "Probabilities were calibrated on simulated drives. The nats behind them are raw log evidence, which is far "
        "overconfident.",
        opened=True,
    )


def _shrinkage(found: Diagnosis) -> Picture | None:
    scores = found.shrinkage
    if scores is None or not _over_horizons(scores):
        return None
    top = scores.by_metric[scores.metric]
    return picture_of(
        "shrinkage",
        lambda narrow: shrinkage_figure(found, narrow=narrow),
        "Lines of the error over the length of the rollouts: baseline simulator, baseline with a black box, with the "
        f"effect, noise floor. By the measure that decides, {top.before:.2g} without and {top.after:.2g} with the "
        f"effect, of which {top.floor:.2g} is noise.",
        measure_table(scores),
        caption="Bold in the table: the measure that decides.",
        opened=True,
    )


def _next(experiment: Experiment) -> Picture:
    m = experiment.manoeuvre
    rows = _some(np.column_stack([m.time, m.command, m.speed]))
    columns = ("time [s]", "command [m/s²]", "expected speed [m/s]")
    return picture_of(
        "next",
        lambda narrow: experiment_figure(experiment, narrow=narrow),
        f"Lines over {m.time[-1]:.0f} s: a command of {m.command.min():.2g} to {m.command.max():.2g} m/s² and the "
        f"expected speed, {m.speed.min():.2g} to {m.speed.max():.2g} m/s.",
        of_numbers(f"The manoeuvre {m.name}", columns, rows, (".1f", ".2f", ".1f")),
        caption="The commands row by row are in manoeuvre.csv. A command holds until the next row; the speed is the "
        "prediction of the most probable hypothesis. Use a level road if there is one.",
    )


def _over_horizons(shrinkage: Shrinkage) -> bool:
    """Whether errors are known over several horizons, so that there is a line to draw."""
    return len({metric.horizon_s for metric in shrinkage.by_metric.values()}) > 1


def _some(rows: np.ndarray) -> Sequence[Sequence[float]]:
    """At most `_MOST` of the rows, evenly spaced, the first among them."""
    return rows[:: -(-len(rows) // _MOST)].tolist()


def _quantity(label: str) -> str:
    return label.partition(" [")[0]


def _unit(label: str) -> str:
    return label.partition("[")[2].rstrip("]")
