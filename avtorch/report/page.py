"""A self-contained page: text, tables and pictures of a diagnosis. It loads nothing, and all text from the log is
escaped."""

from __future__ import annotations

import io
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from importlib.resources import files
from os import PathLike
from pathlib import Path
from typing import Any

import matplotlib as mpl
from jinja2 import Environment, StrictUndefined
from markupsafe import Markup
from matplotlib.figure import Figure

from avtorch.errors import printable
from avtorch.experiment import Experiment
from avtorch.gap.budget.parts import Budget
from avtorch.gap.crossval.localisation import UNITS
from avtorch.gap.quantity import unit_of, words_of
from avtorch.gap.result import sentences
from avtorch.gap.result.diagnosis import Diagnosis, Quantity, Shrinkage
from avtorch.io import atomic
from avtorch.plots.diagnosis import budget_figure, road_figure, shrinkage_figure, where_figure, which_figure
from avtorch.plots.experiment import experiment_figure
from avtorch.version import __version__

_METRICS = {
    "rollout_rmse_accel_0.5s": "acceleration, {horizon} s [m/s²]",
    "rollout_rmse_accel_2s": "acceleration, {horizon} s [m/s²]",
    "rollout_rmse_accel": "acceleration, {horizon} s [m/s²]",
    "rollout_rmse_accel_whole": "acceleration, whole drive [m/s²]",
    "rollout_rmse_speed_0.5s": "speed, {horizon} s [m/s]",
    "rollout_rmse_speed_2s": "speed, {horizon} s [m/s]",
    "rollout_rmse_speed": "speed, {horizon} s [m/s]",
    "rollout_rmse_speed_whole": "speed, whole drive [m/s]",
    "closed_loop_rmse_speed": "speed, closed loop [m/s]",
    "closed_loop_rmse_spacing": "spacing, closed loop [m]",
    "log_predictive_density": "log predictive density [nats per row]",
}


def report_html(
    found: Diagnosis,
    *,
    quality: Iterable[str] = (),
    experiment: Experiment | None = None,
    sections: Mapping[str, Sequence[str]] | None = None,
) -> str:
    """The page as text.

    `quality`: notes from reading the data, one line each. `experiment`: what to drive next, for its picture.
    `sections`: further lines after the verdict, by title.

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
    environment = Environment(
        autoescape=True, undefined=StrictUndefined, finalize=_seen, trim_blocks=True, lstrip_blocks=True
    )
    template = environment.from_string(files("avtorch.report").joinpath("template.html").read_text(encoding="utf-8"))
    return template.render(
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
        parts=[_part(found, w) for w in found.where],
        gap=[*sentences.gap(found), *sentences.moved(found), *sentences.remains(found)],
        budget=[] if found.budget is None else _budget(found.budget),
        candidates=[_candidate(found, c) for c in found.candidates[:10]],
        shrinkage=sentences.shrinkage(found),
        measures=_measures(found),
        placebo=_placebo(found),
        setting=_setting(found),
        sections=dict(sections or {}),
        next_experiment=sentences.to_drive(found),
        notes=list(found.notes),
        quality=list(quality),
        version=__version__,
        pictures=_pictures(found, experiment),
    )


def _seen(value: Any) -> Any:
    """Text of a page, its control characters escaped; markup of our own, the pictures, as it is."""
    return value if isinstance(value, Markup) or not isinstance(value, str) else printable(value)


def write_report(
    found: Diagnosis,
    folder: str | PathLike[str],
    *,
    quality: Iterable[str] = (),
    experiment: Experiment | None = None,
    sections: Mapping[str, Sequence[str]] | None = None,
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
    text = report_html(found, quality=quality, experiment=experiment, sections=sections)
    with atomic(path) as stream:
        stream.write(text)
    return path


def _pictures(found: Diagnosis, experiment: Experiment | None) -> dict[str, Markup | None]:
    drawn: dict[str, tuple[bool, Callable[[Diagnosis], Figure]]] = {
        "budget": (found.budget is not None and bool(found.budget.parts), budget_figure),
        "road": (found.traces is not None, road_figure),
        "where": (found.traces is not None and bool(found.traces.does.any()), where_figure),
        "which": (True, which_figure),
        "shrinkage": (found.shrinkage is not None and _over_horizons(found.shrinkage), shrinkage_figure),
    }
    pictures = {name: _svg(name, draw(found)) if there else None for name, (there, draw) in drawn.items()}
    return pictures | {"next": None if experiment is None else _svg("next", experiment_figure(experiment))}


def _over_horizons(shrinkage: Shrinkage) -> bool:
    """Whether errors are known over several horizons, so that there is a line to draw."""
    return len({metric.horizon_s for metric in shrinkage.by_metric.values()}) > 1


def _svg(name: str, figure: Figure) -> Markup:
    """An inline SVG: text as text, no date, equal for equal figures, with ids that are unique on the page."""
    stream = io.StringIO()
    with mpl.rc_context({"svg.fonttype": "none", "svg.hashsalt": "avtorch"}):
        figure.savefig(stream, format="svg", metadata=dict.fromkeys(("Date", "Creator", "Format", "Type")))
    text = re.sub(r'(\bid="|url\(#|href="#)', rf"\g<1>{name}-", stream.getvalue())
    # matplotlib escapes what it writes; the prologue has no place inside a page
    return Markup(text[text.index("<svg") :])


def _number(q: Quantity | None, digits: int = 3) -> str:
    if q is None:
        return ""
    return f"{q.mean:.{digits}g} ({q.q05:.{digits}g} to {q.q95:.{digits}g})"


def _candidate(found: Diagnosis, c: Any) -> Mapping[str, Any]:
    parameters = _parameters(c.parameters) if len(c.effects) < 3 else []
    parameters += ["physically implausible"] if c.implausible and c.name != "unknown" else []
    return {
        "name": c.name.replace("+", " + ") if len(c.effects) < 3 else f"these {len(c.effects)} effects",
        "probability": sentences.number(c.probability),
        "width": round(100 * c.probability, 1),
        "nats": "" if c.log_evidence is None else f"{c.log_evidence:+.0f}",
        "parameters": parameters,
        "near": c.name in found.verdict.alias_set,
    }


def _budget(budget: Budget) -> list[Mapping[str, Any]]:
    """Rows of the budget's table."""
    rows: list[Mapping[str, Any]] = [
        {
            "name": part.name,
            "share": _percent(part.share),
            "probability": sentences.number(part.probability),
            "parameters": _parameters(part.parameters) + ([] if part.plausible else ["physically implausible"]),
            "alike": [name for name in part.alias_set if name != part.name],
        }
        for part in budget.parts
    ]
    rows += [
        {
            "name": part.name,
            "share": "by chance, part of the noise",
            "probability": sentences.number(part.probability),
            "parameters": _parameters(part.parameters or {}) + ([] if part.plausible else ["physically implausible"]),
            "alike": [],
        }
        for part in budget.chance
    ]
    rest = {"probability": "", "parameters": [], "alike": []}
    return [*rows, {"name": "unexplained", "share": _percent(budget.unexplained.share), **rest}] if rows else []


def _parameters(parameters: Mapping[str, Quantity]) -> list[str]:
    words = []
    for key, q in parameters.items():
        unit = unit_of(key)
        words.append(f"{words_of(key.rpartition('.')[2])} {_number(q)}{'' if unit == '-' else ' ' + unit}")
    return words


def _part(found: Diagnosis, part: Any) -> Mapping[str, str]:
    unit = UNITS[part.axis]
    if part.axis == "time":
        begin, end = (t - found.log.epochs_s[0] for t in (part.begin, part.end))
        ends = f"{begin:.1f} to {end:.1f} s from the log's start"
        return _row(part, ends)
    ends = part.begin if part.axis == "signal" else f"{part.begin:.3g} to {part.end:.3g} {unit}"
    return _row(part, ends)


def _row(part: Any, ends: str) -> Mapping[str, str]:
    return {"axis": part.axis, "ends": ends, "share": f"{100 * part.share:.0f} %", "q": _small(part.q_value)}


def _small(p: float) -> str:
    return "<1e-12" if p < 1e-12 else f"{p:.1g}"


def _measures(found: Diagnosis) -> Sequence[Mapping[str, Any]]:
    shrinkage = found.shrinkage
    if shrinkage is None:
        return []
    return [
        {
            "name": _METRICS.get(name, name).format(horizon=f"{c.horizon_s or 0:.3g}"),
            "before": f"{c.before:.3g}",
            "after": f"{c.after:.3g}",
            "floor": f"{c.floor:.3g}",
            "ceiling": f"{shrinkage.ceiling[name]:.3g}",
            "closed": "" if c.closed is None else _percent(c.closed),
            "top": name == shrinkage.metric,
        }
        for name, c in shrinkage.by_metric.items()
    ]


def _percent(q: Quantity) -> str:
    mean, low, high = (round(100 * x) for x in (q.mean, q.q05, q.q95))
    return f"{mean} % ({low} to {high})"


def _placebo(found: Diagnosis) -> str | None:
    shrinkage = found.shrinkage
    if shrinkage is None or shrinkage.placebo is None or shrinkage.placebo_effect is None:
        return None
    closed = _percent(shrinkage.placebo)
    return f"A placebo ({shrinkage.placebo_effect}, a wrong effect added to the verdict) closes {closed}."


def _peak(peak: Mapping[str, float | None]) -> str:
    """A peak gain with its 90 % interval."""
    middle, low, high = (f"{x:.2f}" if x is not None else "no end" for x in (peak[k] for k in ("median", "q05", "q95")))
    return f"{middle} ({low} to {high})"


def _setting(found: Diagnosis) -> Mapping[str, Any] | None:
    if found.setting is None:
        return None
    setting, p = found.setting, found.setting["p_string_stable"]
    peaks = {k: _peak(x) for k, x in setting["peak_gain"].items()}
    return {
        "why": setting["why"],
        "rows": [
            ("P(string stable), baseline simulator", f"{p['assumed']:.2f}"),
            ("P(string stable), repaired simulator", f"{p['in_force']:.2f}"),
            ("P(string stable), with this setting", f"{p['then']:.2f}"),
            ("peak gain, baseline simulator", peaks["assumed"]),
            ("peak gain, repaired simulator", peaks["in_force"]),
            ("peak gain, with this setting", peaks["then"]),
        ],
        "notes": setting["notes"],
    }
