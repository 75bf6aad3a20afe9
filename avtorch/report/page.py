"""A self-contained page: text, tables and pictures of a diagnosis. It loads nothing, and all text from the log is
escaped."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from os import PathLike
from pathlib import Path

from avtorch.experiment import Experiment
from avtorch.gap.result import sentences
from avtorch.gap.result.diagnosis import Diagnosis
from avtorch.io import atomic
from avtorch.report.entries import measure_table, percent, place_table, setting_table
from avtorch.report.house import page_of
from avtorch.report.manoeuvre_pictures import manoeuvre_pictures
from avtorch.report.origin import Origin
from avtorch.report.pictures import pictures
from avtorch.report.residual_section import residual_section


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

    Example:
        >>> from avtorch import Leader, diagnose, simulate
        >>> from avtorch.gap import DeadTime, plant
        >>> from avtorch.report import report_html
        >>> late = plant([DeadTime(0.4)], sigma=0.0)
        >>> log = simulate(Leader.default(start=50.0, duration=14.0, dt=0.1), plant=late).log()
        >>> page = report_html(diagnose(log, effects=["dead_time"], pairs=False))
        >>> "dead_time" in page, page.rstrip().endswith("</html>")
        (True, True)
    """
    return page_of(
        "diagnosis.html",
        origin=origin,
        found=found,
        log=found.log,
        headline=sentences.headline(found),
        odd=found.winner.implausible,
        lead=[
            *sentences.tested(found),
            *sentences.budget(found),
            found.verdict.why,
            sentences.aliases(found),
            *sentences.onset(found),
        ],
        tone="amber"
        if found.winner.implausible
        else {"unknown": "amber", "none": "green"}.get(found.verdict.name, "blue"),
        where=sentences.where(found),
        places=place_table(found),
        gap=[*sentences.gap(found), *sentences.moved(found), *sentences.remains(found)],
        shrinkage=sentences.shrinkage(found),
        measures=None if found.shrinkage is None else measure_table(found.shrinkage),
        placebo=_placebo(found),
        setting=setting_table(found),
        sections=dict(sections or {}),
        next_experiment=sentences.to_drive(found),
        notes=list(found.notes),
        quality=list(quality),
        pictures=pictures(found, experiment),
        left=residual_section(found),
        each_manoeuvre=manoeuvre_pictures(found),
    )


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
    path = Path(folder) / "report.html"
    text = report_html(found, quality=quality, experiment=experiment, sections=sections, origin=origin)
    with atomic(path) as stream:
        stream.write(text)
    return path


def _placebo(found: Diagnosis) -> str | None:
    shrinkage = found.shrinkage
    if shrinkage is None or shrinkage.placebo is None or shrinkage.placebo_effect is None:
        return None
    closed = percent(shrinkage.placebo)
    return f"A placebo ({shrinkage.placebo_effect}, a wrong effect added to the verdict) closes {closed}."
