"""The page of a diagnosis: the verdict and the gap's budget, where the gap lies, what is left, what to do."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from avtorch.experiment import Experiment
from avtorch.gap.result import sentences
from avtorch.gap.result.budget import UNITS
from avtorch.gap.result.budget import percent as share_of
from avtorch.gap.result.diagnosis import Diagnosis
from avtorch.gap.result.manoeuvres import Manoeuvre, manoeuvres
from avtorch.plots import diagnosis as drawings
from avtorch.plots import drive
from avtorch.report.diagnosis_tables import (
    budget_table,
    candidate_table,
    family_table,
    measure_table,
    place_table,
    setting_table,
)
from avtorch.report.page import Origin, Page, Picture, Section, picture_of, small_picture, written
from avtorch.report.residuals import residuals
from avtorch.report.table import Table, of_numbers

if TYPE_CHECKING:
    from avtorch.report.page import Tone

_MOST = 60  # rows of a table behind a picture of lines
_PARTS = 12  # of the drive, rows of its table
_ALARMS = 6  # named in the words below a picture
_NOT_COUNTED = {
    "driver": "grey, the driver's hand",
    "standstill": "hatched upwards, standstill",
    "gap": "hatched downwards, no rows",
    "settling": "pale, the first seconds of a drive and after a return",
}
_METHOD = (
    "Each hypothesis is a whole simulator and recorder, rolled out over the drive from the logged commands. Its errors "
    "are compared in short frames and bands of frequency, in each of which the noise is free. The probabilities come "
    "from the evidence, tempered on simulated cars."
)
_PROVISIONAL = "Provisional: the budget ended the search before all hypotheses were tried."
_LIMITS = (
    "Effects out of a table, some at once; a cause outside it may be attributed to the nearest effect, or to two.",
    "On a real car trust the order of the hypotheses and the alias set, not the third digit.",
    "Stability is evaluated for small motions, at several speeds, with a linear controller.",
)


def report_html(
    found: Diagnosis,
    *,
    quality: Iterable[str] = (),
    experiment: Experiment | None = None,
    sections: Mapping[str, Sequence[str]] | None = None,
    origin: Origin | None = None,
) -> str:
    """The page as text.

    `quality`: notes from reading the data, one line each. `experiment`: what to drive next, for its picture.
    `sections`: further lines after the verdict, by title. `origin`: how the answer was made, for the footer.
    """
    log, budget, odd = found.log, found.budget, found.winner.implausible
    tones: dict[str, Tone] = {"unknown": "amber", "none": "green"}
    segments = f"{log.rows} rows in {log.segments} segment{'' if log.segments == 1 else 's'}"
    page = Page(
        "Diagnosis",
        f"{log.name} · {log.seconds:.0f} s at {log.rate_hz:.3g} Hz",
        Section(
            sentences.headline(found),
            (*_rest(found), *odd, *(() if found.complete else (_PROVISIONAL,))),
            (_budget(found), _free_form(found), _drive(found), _road(found)),
        ),
        (
            Section("In words", _words(found)),
            *(Section(title, lines) for title, lines in (sections or {}).items()),
            Section(
                "Where the gap lies",
                tuple(sentences.where(found)) or ("No part of the drive stands out.",),
                (_where(found),),
                tables=(place_table(found),),
                soft=(*sentences.gap(found), *sentences.moved(found), *sentences.remains(found)),
            ),
            Section(
                "Which effect", pictures=(_which(found),), tables=() if budget is None else (family_table(budget),)
            ),
            _manoeuvres(found),
            residuals(found),
            _shrinkage(found),
            _setting(found),
            Section(
                "What to drive next",
                sentences.to_drive(found),
                () if experiment is None or not sentences.to_drive(found) else (_next(experiment),),
            ),
            Section("The data", (f"{segments}; signals: {', '.join(log.signals)}.",), items=(*quality,)),
            Section("Method and limits", (_METHOD,), items=(*_LIMITS, *found.notes)),
        ),
        "amber" if odd else tones.get(found.verdict.name, "blue"),
    )
    return page.html(origin)


def write_report(
    found: Diagnosis,
    folder: str | PathLike[str],
    *,
    quality: Iterable[str] = (),
    experiment: Experiment | None = None,
    sections: Mapping[str, Sequence[str]] | None = None,
    origin: Origin | None = None,
) -> Path:
    """Write `report.html` into `folder`; returns its path. Raises `InputError` where it cannot be written.

    Example:
        >>> from avtorch import Leader, diagnose, simulate
        >>> from avtorch.gap import DeadTime, plant
        >>> from avtorch.report import write_report
        >>> late = plant([DeadTime(0.4)], sigma=0.0)
        >>> log = simulate(Leader.default(start=50.0, duration=14.0, dt=0.1), plant=late).log()
        >>> write_report(diagnose(log, effects=["dead_time"], pairs=False), "out").name
        'report.html'
    """
    text = report_html(found, quality=quality, experiment=experiment, sections=sections, origin=origin)
    return written(text, folder, "report.html")


# the verdict -------------------------------------------------------------------------------------------------------
def _rest(found: Diagnosis) -> tuple[str, ...]:
    """What the error that is left is, beside the headline."""
    return () if found.budget is None or not found.budget.rest else (found.budget.rest,)


def _words(found: Diagnosis) -> list[str]:
    told = [line for line in sentences.budget(found) if line not in _rest(found)]
    lines = [*sentences.tested(found), *told, found.verdict.why, sentences.aliases(found)]
    lines += [*sentences.onset(found), *sentences.shrinkage(found)]
    if found.setting is not None:
        why = str(found.setting["why"])
        lines.append(why if why.startswith("Nothing to set") else f"To set: {why}")
    return lines


def _budget(found: Diagnosis) -> Picture | None:
    """Shares of the gap, or where no effect takes anything off it what the error consists of."""
    budget = found.budget
    if budget is None:
        return None
    (rest, noise), over = budget.error, f"the squared error of {budget.horizon_s:.3g} s simulations"
    if budget.parts:
        rest_of = budget.unexplained
        shares = [(part.name, part.share) for part in budget.parts]
        shares += [] if rest_of.carried is None else [("a force without a name", rest_of.carried)]
        shares += [("unexplained", rest_of.beyond_carried)]
        told = ", ".join(f"{name} {100 * share.mean:.0f} %" for name, share in shares)
        says = f"Bars of what each effect contributes to the gap: {told}."
        caption = (
            f"A share is what an effect takes off {over}, above that of noise alone, on parts of the drive not used "
            "for fitting; effects are added in the order shown. Black lines: 90 % intervals."
            + ("" if rest_of.carried is None else " The repaired simulator carries the force that has no name.")
        )
    else:
        says = (
            "Bars of what the error of the baseline simulator consists of: "
            f"unexplained {share_of(rest.mean)}, noise {share_of(noise.mean)}."
        )
        counts = "What is unexplained does not count: it is too little, or not sure." if rest.mean else ""
        counts = f"{counts} The error is {budget.unexplained.rest(budget.material)}.".strip()
        caption = (
            f"Shares of {over} by the baseline, on parts of the drive not used for fitting. Noise is what commands, "
            "speed and place do not predict; what is unexplained is reproducible, and no known effect reduces it. "
            "Black lines: 90 % intervals."
            f"{'' if budget.unexplained.material else f' {counts}'}"
        )
    table = budget_table(budget, found.log.epochs_s[0])
    draw = lambda narrow: drawings.budget_figure(found, narrow=narrow)  # noqa: E731
    return picture_of("budget", draw, says, table, caption=caption, opened=True)


def _free_form(found: Diagnosis) -> Picture | None:
    form = found.free_form
    if form is None or not form.sizes.any:
        return None
    u, v = form.knots_u, form.knots_v
    columns, rows, says = ["speed [m/s]"], v[:, None], []
    across, _, cells = drawings.driven_cells(found)
    low, high = across[[0, -1]]
    if form.sizes.table > 0:
        says.append(
            f"Contours of the force beyond K u over speed, {low:.3g} to {high:.3g} m/s, and command, {u[0]:.2g} to "
            f"{u[-1]:.2g} m/s²: {form.at.table.min():.2g} to {form.at.table.max():.2g} m/s²; {100 * cells.mean():.0f} "
            "% of the cells were driven."
        )
        columns += [f"force beyond K u at {x:.2g} m/s² [m/s²]" for x in u]
        rows = np.column_stack([rows, form.at.table.T])
    if form.sizes.resistance > 0:
        curve = np.interp(across, v, form.at.curve)
        says.append(
            f"A line of the resistance, at the speeds driven {curve.min():.2g} to {curve.max():.2g} m/s²; at others it "
            "goes on along a line."
        )
        columns.append("resistance [m/s²]")
        rows = np.column_stack([rows, form.at.curve])
    return picture_of(
        "free_form",
        lambda narrow: drawings.free_form_figure(found, narrow=narrow),
        " ".join(says),
        of_numbers("What the repaired simulator carries without a name", columns, rows, (".3g",) * len(columns)),
        caption="What the car's force does beyond the gain and what was named, as the repaired simulator carries it. "
        "Hatched: not driven; there nothing but its smoothness speaks, and far from the drive it goes back to K u. A "
        "dead band, a limit or an asymmetry of the drive may hide in it.",
    )


def _drive(found: Diagnosis) -> Picture | None:
    traces = found.traces
    if traces is None or len(traces.time) < _PARTS:
        return None
    axis = drive.drive_time(found)
    columns = ["part of the drive [s]", "command, least to greatest [m/s²]"]
    for name in traces.channels:
        unit = "m/s²" if name == "accel" else "m/s"
        columns += [f"{name} [{unit}]", f"{name}, error without [{unit}]", f"{name}, error with [{unit}]"]
    errors = [traces.measured - traces.begun_anew(x) for x in (traces.before, traces.after)]
    rows = []
    for part in np.array_split(np.arange(len(axis.along)), _PARTS):
        command = traces.command[part]
        cells = [
            f"{axis.along[part[0]]:.0f} to {axis.along[part[-1]]:.0f}",
            f"{command.min():.2f} to {command.max():.2f}",
        ]
        for k in range(len(traces.channels)):
            sizes = [np.std(traces.measured[k][part]), *(np.sqrt(np.mean(x[k][part] ** 2)) for x in errors)]
            cells += [f"{size:.3f}" for size in sizes]
        rows.append(tuple(cells))
    named = " and that with what was named" if found.winner.effects else ""
    return picture_of(
        "drive",
        lambda narrow: drive.drive_figure(found, narrow=narrow),
        f"Lines over the whole drive, {axis.along[0]:.0f} to {axis.along[-1]:.0f} s: the command, the measured "
        f"{' and '.join(traces.channels)}, the baseline simulator{named}.{_marked(axis)}",
        Table("The drive in parts: standard deviation of each signal, RMS of each error", tuple(columns), tuple(rows)),
        caption="Each line shows the least and the greatest value of short intervals. Simulated lines come from the "
        f"logged commands; every ten seconds a speed begins at the measured one.{_marked(axis)}{_fit(found)}",
    )


def _fit(found: Diagnosis) -> str:
    """How well the rollouts fit, channel by channel."""
    traces = found.traces
    assert traces is not None
    told = []
    for name, before, after in zip(traces.channels, traces.fit(traces.before), traces.fit(traces.after), strict=True):
        if np.isfinite(before):
            named = f" without what was named, {after:.0f} % with it" if found.winner.effects else ""
            told.append(f"{ {'accel': 'acceleration'}.get(name, name) } {before:.0f} %{named}")
    scale = "Fit of the simulated lines (100 % is exact, 0 % no better than the mean)"
    return f" {scale}: {'; '.join(told)}." if told else ""


def _marked(axis: drive.DriveTime) -> str:
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
    traces = found.traces
    if traces is None:
        return None
    stretch = drawings.stretch_of(found)
    quantity, unit = stretch.axis.rstrip("]").split(" [")
    labels, lines = list(stretch.lines), list(stretch.lines.values())
    off = " and ".join(
        f"{np.sqrt(np.mean((line - lines[0]) ** 2)):.2g} {unit} {label}"
        for label, line in zip(labels[1:], lines[1:], strict=True)
    )
    which = "The stretch of the drive in which the effect is strongest."
    if (traces.before == traces.after).all():
        which = "The beginning of the drive; nothing was named that another stretch would show better."
    columns = ("time [s]", *(f"{label} [{unit}]" for label in labels))
    rows = _some(np.column_stack([stretch.time, *lines]))
    return picture_of(
        "road",
        lambda narrow: drawings.road_figure(found, narrow=narrow),
        f"Lines of {quantity} over time, {stretch.time[0]:.0f} to {stretch.time[-1]:.0f} s: "
        f"{', '.join(labels)}. RMS error: {off}.",
        of_numbers(f"The {quantity} in this stretch", columns, rows, (".2f", *(".3f" for _ in labels))),
        caption=f"{which} Simulated lines: the simulator gets the logged commands and never the measured acceleration; "
        "its speed starts at the measured one.",
    )


def _some(rows: np.ndarray) -> Sequence[Sequence[float]]:
    """At most `_MOST` of the rows, evenly spaced, the first among them."""
    return rows[:: -(-len(rows) // _MOST)].tolist()


# where, which, how far ---------------------------------------------------------------------------------------------
def _where(found: Diagnosis) -> Picture | None:
    traces = found.traces
    # where nothing is missing no effect is named whose place could be drawn
    if traces is None or not traces.does.any() or found.verdict.name == "none":
        return None
    axes = drawings.axes_of(found)
    tables = []
    for axis in axes:
        shares = drawings.histogram_of(found, axis, bins=15)
        rows = [
            (f"{a:.3g} to {b:.3g}", f"{100 * rows:.0f} %", f"{100 * effect:.0f} %")
            for a, b, rows, effect in zip(shares.edges, shares.edges[1:], shares.rows, shares.effect, strict=False)
        ]
        columns = (f"{axis} [{UNITS[axis]}]", "share of the drive", "share of the effect")
        tables.append(Table(f"Along {axis}", columns, tuple(rows), numeric=columns[1:]))
    said = " ".join(sentences.where(found)) or "No part of the drive stands out."
    return picture_of(
        "where",
        lambda narrow: drawings.where_figure(found, narrow=narrow),
        f"Histograms along {', '.join(axes)}: the share of the drive beside the share of the effect. {said}",
        *tables,
        caption="Where the blue line is above the grey ground, the effect acts more than its share of the drive.",
    )


def _which(found: Diagnosis) -> Picture:
    bars = ", ".join(f"{c.name.replace('+', ' + ')} {sentences.number(c.probability)}" for c in found.candidates[:3])
    return picture_of(
        "which",
        lambda narrow: drawings.which_figure(found, narrow=narrow),
        f"Bars of the probability of each hypothesis: {bars}.",
        candidate_table(found),
        caption="Blue, and bold in the table: the alias set, which this log cannot distinguish from the verdict. "
        "Probabilities were calibrated on simulated drives. The nats behind them are raw log evidence over none, which "
        "is far overconfident.",
        opened=True,
    )


def _shrinkage(found: Diagnosis) -> Section:
    """Errors on data held out; over several horizons as a picture."""
    title, scores = "How far the gap shrinks", found.shrinkage
    if scores is None or not scores.by_metric:
        return Section(title)
    others = "the other drives" if scores.by_drives else "the other folds"
    how = (
        f"Cross-validated on {scores.blocks} blocks of the drives: each is scored by a simulator selected and fitted "
        f"on {others} alone."
    )
    measures = measure_table(scores)
    if len({metric.horizon_s for metric in scores.by_metric.values()}) < 2:
        return Section(title, (how,), tables=(measures,))
    top = scores.by_metric[scores.metric]
    drawn = picture_of(
        "shrinkage",
        lambda narrow: drawings.shrinkage_figure(found, narrow=narrow),
        "Bars of the error in held-out rollouts: baseline simulator, baseline with a black box, with the "
        f"effect, noise floor. By the measure that decides, {top.before:.2g} without and {top.after:.2g} with the "
        f"effect, of which {top.floor:.2g} is noise.",
        measures,
        caption="Bold in the table: the measure that decides.",
        opened=True,
    )
    return Section(title, (how,), (drawn,))


# what to do --------------------------------------------------------------------------------------------------------
def _setting(found: Diagnosis) -> Section:
    if found.setting is None:
        return Section("What to set")
    assumed = (
        "Unless another controller was given, this assumes a linear one with a time gap of 1 s and the paper's gains."
    )
    soft = (*found.setting["notes"], assumed)
    return Section("What to set", (str(found.setting["why"]),), tables=(setting_table(found.setting),), soft=soft)


def _next(experiment: Experiment) -> Picture:
    m = experiment.manoeuvre
    columns = ("time [s]", "command [m/s²]", "expected speed [m/s]")
    rows = _some(np.column_stack([m.time, m.command, m.speed]))
    return picture_of(
        "next",
        lambda narrow: drive.experiment_figure(experiment, narrow=narrow),
        f"Lines over {m.time[-1]:.0f} s: a command of {m.command.min():.2g} to {m.command.max():.2g} m/s² and the "
        f"expected speed, {m.speed.min():.2g} to {m.speed.max():.2g} m/s.",
        of_numbers(f"The manoeuvre {m.name}", columns, rows, (".1f", ".2f", ".1f")),
        caption="The commands row by row are in manoeuvre.csv. A command holds until the next row; the speed is the "
        "prediction of the most probable hypothesis. Use a level road if there is one.",
    )


# manoeuvres --------------------------------------------------------------------------------------------------------
def _manoeuvres(found: Diagnosis) -> Section:
    """The manoeuvres in which the baseline simulator errs most, the worst first."""
    title, traces = "Manoeuvre by manoeuvre", found.traces
    if traces is None:
        return Section(title)
    several = len(found.log.epochs_s) > 1
    each = manoeuvres(traces, named=bool(found.winner.effects))
    columns = ("signal", "peak [m/s²]", "rise, 10 to 90 % [s]", "lag behind the command [s]")
    pictures = []
    for i, one in enumerate(each):
        of = f" of drive {one.log + 1}" if several else ""
        name = f"{one.kind.capitalize()} at {one.begin:.1f} s{of}, a command {one.change:+.2g} m/s²"
        rows = [
            (label, f"{r.peak:.2f}", *("" if x is None else f"{x:.2f}" for x in (r.rise, r.lag)))
            for label, r in one.responses.items()
        ]
        pictures.append(
            small_picture(
                f"manoeuvre-{i}",
                drive.manoeuvre_figure(one, traces),
                f"Lines of a manoeuvre: {name}. {_responses(one)}",
                Table(name, columns, tuple(rows), numeric=columns[1:]),
                caption=f"{name}: {100 * one.share:.2g} % of the baseline's squared error. {_responses(one)}",
            )
        )
    said = ("Where the baseline simulator errs most, the worst first.",) if pictures else ()
    return Section(title, said, small=tuple(pictures))


def _responses(manoeuvre: Manoeuvre) -> str:
    """Peaks, rises and lags in words."""
    words = {"measured": "the car", "baseline simulator": "the baseline simulator"}
    answers = {words.get(name, name): r for name, r in manoeuvre.responses.items() if name != "command"}
    told = [f"Peak [m/s²]: {', '.join(f'{who} {r.peak:.2f}' for who, r in answers.items())}."]
    for title, key in (("Rise", "rise"), ("Lag", "lag")):
        known = [f"{who} {getattr(r, key):.2f}" for who, r in answers.items() if getattr(r, key) is not None]
        told += [f"{title} [s]: {', '.join(known)}."] if known else []
    return " ".join(told)
