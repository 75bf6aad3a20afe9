"""The page of a diagnosis: the verdict and the gap's budget, where the gap lies, what is left, what to do."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from avtorch.arrays import FloatArray
from avtorch.experiment import Experiment
from avtorch.gap.result import sentences
from avtorch.gap.result.budget import percent as share_of
from avtorch.gap.result.diagnosis import Diagnosis
from avtorch.gap.result.manoeuvres import manoeuvres
from avtorch.gap.result.residuals import BLOCK_S, BinnedMeans, Correlation, binned_means, correlation, spectrum, usual
from avtorch.gap.result.traces import Traces
from avtorch.gap.simulator.force_table import ForceTable
from avtorch.plots import diagnosis as drawings
from avtorch.plots import drive
from avtorch.report.diagnosis_tables import (
    budget_table,
    candidate_table,
    family_table,
    manoeuvre_name,
    manoeuvre_table,
    measure_table,
    place_table,
    setting_table,
)
from avtorch.report.page import Origin, Page, Picture, Section, picture_of, written
from avtorch.report.table import Table

if TYPE_CHECKING:
    from avtorch.report.page import Tone

_PARTS = 12  # of the drive, rows of its table
_ALARMS = 6  # named in the words below a picture
_LEAST = 100  # rows of residuals from which there is something to see
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
            _residuals(found),
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
    return [*lines, *sentences.onset(found), *sentences.shrinkage(found), *sentences.to_set(found)]


def _budget(found: Diagnosis) -> Picture | None:
    """Shares of the gap, or where no effect takes anything off it what the error consists of."""
    budget = found.budget
    if budget is None:
        return None
    rest, over = budget.unexplained, f"the squared error of {budget.horizon_s:.3g} s simulations"
    told = ", ".join(f"{name} {share_of(share.mean)}" for name, share in budget.shares.items())
    if budget.parts:
        says = f"Bars of what each effect contributes to the gap: {told}."
        caption = (
            f"A share is what an effect takes off {over}, above that of noise alone, on parts of the drive not used "
            "for fitting; effects are added in the order shown. Black lines: 90 % intervals."
            + ("" if rest.carried is None else " The repaired simulator carries the force that has no name.")
        )
    else:
        says = f"Bars of what the error of the baseline simulator consists of: {told}."
        counts = "What is unexplained does not count: it is too little, or not sure." if budget.left_above_noise else ""
        counts = f"{counts} The error is {rest.rest(budget.material)}.".strip()
        caption = (
            f"Shares of {over} by the baseline, on parts of the drive not used for fitting. Noise is what commands, "
            "speed and place do not predict; what is unexplained is reproducible, and no known effect reduces it. "
            "Black lines: 90 % intervals."
            f"{'' if rest.material else f' {counts}'}"
        )
    table = budget_table(budget, found.log.epochs_s[0])
    return picture_of("budget", drawings.budget_figure(found), table, says=says, caption=caption, opened=True)


def _free_form(found: Diagnosis) -> Picture | None:
    if not found.free_form:
        return None
    columns, values = ["speed [m/s]"], [found.free_form[0].speed_mps]
    for part in found.free_form:
        if isinstance(part, ForceTable):
            columns += [f"force beyond K u at {x:.2g} m/s² [m/s²]" for x in part.command_mps2]
            values += part.force_mps2
        else:
            columns.append("resistance [m/s²]")
            values.append(part.force_mps2)
    rows = tuple(tuple(f"{x:.3g}" for x in row) for row in zip(*values, strict=True))
    return picture_of(
        "free_form",
        drawings.free_form_figure(found),
        Table("What the repaired simulator carries without a name", tuple(columns), rows, numeric=columns),
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
    return picture_of(
        "drive",
        drive.drive_figure(found),
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
        told.append(f" Shaded: {sum(x.end - x.begin for x in axis.uncounted):.0f} s that did not count.")
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
    which = "The stretch of the drive in which the effect is strongest."
    if (traces.before == traces.after).all():
        which = "The beginning of the drive; nothing was named that another stretch would show better."
    return picture_of(
        "road",
        drawings.road_figure(found),
        caption=f"{which} Simulated lines: the simulator gets the logged commands and never the measured acceleration; "
        "its speed starts at the measured one.",
    )


# where, which, how far ---------------------------------------------------------------------------------------------
def _where(found: Diagnosis) -> Picture | None:
    traces = found.traces
    # where nothing is missing no effect is named whose place could be drawn
    if traces is None or not traces.does.any() or found.verdict.name == "none":
        return None
    return picture_of(
        "where",
        drawings.where_figure(found),
        caption="Where the blue line is above the grey ground, the effect acts more than its share of the drive.",
    )


def _which(found: Diagnosis) -> Picture:
    bars = ", ".join(f"{c.name.replace('+', ' + ')} {sentences.number(c.probability)}" for c in found.candidates[:3])
    return picture_of(
        "which",
        drawings.which_figure(found),
        candidate_table(found),
        says=f"Bars of the probability of each hypothesis: {bars}.",
        caption="Blue, and bold in the table: the alias set, which this log cannot distinguish from the verdict. "
        "Probabilities were calibrated on simulated drives. The nats behind them are raw log evidence over none, which "
        "is far overconfident.",
        opened=True,
    )


def _shrinkage(found: Diagnosis) -> Section:
    """Errors on data held out."""
    title, scores = "How far the gap shrinks", found.shrinkage
    if scores is None:
        return Section(title)
    others = "the other drives" if scores.by_drives else "the other folds"
    how = (
        f"Cross-validated on {scores.blocks} blocks of the drives: each is scored by a simulator selected and fitted "
        f"on {others} alone."
    )
    drawn = picture_of(
        "shrinkage",
        drawings.shrinkage_figure(found),
        measure_table(scores),
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
    return picture_of(
        "next",
        drive.experiment_figure(experiment),
        caption="The commands row by row are in manoeuvre.csv. A command holds until the next row; the speed is the "
        "prediction of the most probable hypothesis. Use a level road if there is one.",
    )


# manoeuvres --------------------------------------------------------------------------------------------------------
def _manoeuvres(found: Diagnosis) -> Section:
    """The manoeuvres in which the baseline simulator errs most, the worst first."""
    title, traces = "Manoeuvre by manoeuvre", found.traces
    if traces is None:
        return Section(title)
    each = manoeuvres(traces, named=bool(found.winner.effects))
    pictures = [
        picture_of(
            f"manoeuvre-{i}",
            drive.manoeuvre_figure(one, traces),
            caption=f"{manoeuvre_name(found, one)}, a command {one.change:+.2g} m/s²: {100 * one.share:.2g} % of the "
            "baseline's squared error.",
        )
        for i, one in enumerate(each)
    ]
    said = ("Where the baseline simulator errs most, the worst first.",) if pictures else ()
    return Section(title, said, small=pictures, tables=(manoeuvre_table(found, each),))


# what is left of the gap -------------------------------------------------------------------------------------------
def _residuals(found: Diagnosis) -> Section:
    """The residuals of a diagnosis; nothing where there is too little to show."""
    title, traces = "What is left: residuals", found.traces
    if traces is None or len(traces.time) < _LEAST:
        return Section(title)
    both = drive.residuals_of(found)
    last = list(both.values())[-1]
    outside = correlation(traces, last)
    pictures = [_residual_against(found, traces, both, axis) for axis in _axes(traces)]
    pictures.append(
        picture_of(
            "residual-correlation",
            drive.residual_figure(found, "earlier commands"),
            caption=f"Against earlier commands: a residual beyond ±{outside.band:.2f}, 99 % of what "
            "chance does, follows the command in a way that the simulator does not.",
        )
    )
    if spectrum(traces, last) is not None:
        pictures.append(
            picture_of(
                "residual-frequency",
                drive.residual_figure(found, "frequency"),
                caption="Against frequency: power averaged over windows of 20 s; bands are 90 %.",
            )
        )
    said = _what_is_left(traces, both, outside)
    return Section(title, said, (_residual_over_time(found, traces, both),), tuple(pictures))


def _axes(traces: Traces) -> list[Literal["command", "speed"]]:
    return ["command"] if traces.speed is None else ["command", "speed"]


def _what_is_left(traces: Traces, both: Mapping[str, FloatArray], outside: Correlation) -> tuple[str, ...]:
    what = (
        "Measured acceleration less that of a rollout over the whole drive"
        if "accel" in traces.channels
        else "Slope over 1 s of the measured speed less that of a rollout over the whole drive"
    )
    sizes = [f"{np.sqrt(np.mean(residual**2)):.2g} m/s² {label}" for label, residual in both.items()]
    said = [f"{what}: {', '.join(sizes)} (root mean square)."]
    last = list(both.values())[-1]
    shows = [axis for axis in _axes(traces) if _apart(binned_means(traces, getattr(traces, axis), last))]
    late = outside.lag[(outside.lag >= 0) & (np.abs(outside.value) > outside.band)]
    who = "The simulator with what was named" if len(both) > 1 else "The baseline simulator"
    if shows:
        said.append(f"{who} still errs by more than chance at some {' and some '.join(f'{x}s' for x in shows)}.")
    if len(late):
        said.append(f"Its residual still follows commands of {late[0]:.1f} to {late[-1]:.1f} s before.")
    if not shows and not len(late):
        said.append("It depends neither on the command, nor on the speed, by more than chance would.")
    return tuple(said)


def _apart(bins: BinnedMeans) -> bool:
    """Whether more bins than chance would exclude 0: of 90 % intervals, one in ten does."""
    known = np.isfinite(bins.low)
    return int(((bins.low > 0) | (bins.high < 0))[known].sum()) > max(2, 0.3 * int(known.sum()))


def _residual_over_time(found: Diagnosis, traces: Traces, both: Mapping[str, FloatArray]) -> Picture:
    columns = ("part of the drive [s]", *(f"{what} {label} [m/s²]" for label in both for what in ("mean", "SD")))
    rows = [
        (
            f"{traces.time[part[0]]:.0f} to {traces.time[part[-1]]:.0f}",
            *(f"{size:.3f}" for residual in both.values() for size in (residual[part].mean(), residual[part].std())),
        )
        for part in np.array_split(np.arange(len(traces.time)), _PARTS)
    ]
    judged = list(both.values())[-1]
    beyond = f"{100 * float(np.mean(np.abs(judged) > usual(judged))):.1f} %"
    return picture_of(
        "residual-time",
        drive.residual_time_figure(found),
        Table("Residual in parts of the drive", columns, tuple(rows), numeric=columns[1:]),
        caption="Grey ground: where 99 % of a steady normal residual with the quartiles of the last line would lie; "
        f"{beyond} lie beyond.",
    )


def _residual_against(
    found: Diagnosis, traces: Traces, both: Mapping[str, FloatArray], axis: Literal["command", "speed"]
) -> Picture:
    unit = "m/s²" if axis == "command" else "m/s"
    rows = []
    for label, residual in both.items():
        bins = binned_means(traces, getattr(traces, axis), residual)
        for place, mean, low, high in zip(bins.place, bins.mean, bins.low, bins.high, strict=True):
            within = f" ({low:.3f} to {high:.3f})" if np.isfinite(low) else ""
            rows.append((f"{place:.3g} {unit}", label, f"{mean:.3f}{within}"))
    return picture_of(
        f"residual-{axis}",
        drive.residual_figure(found, axis),
        Table(f"Mean residual by {axis}", (axis, "simulator", "mean residual (90 %) [m/s²]"), tuple(rows)),
        caption=f"Against the {axis}: means of as many rows each; bands are 90 %, by blocks of {BLOCK_S:.0f} s.",
    )
