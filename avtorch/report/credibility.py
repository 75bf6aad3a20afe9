"""A diagnosis under the headings by which simulation toolchains are assessed: facts of the run, and what it cannot say.

Headings as in the UN's guidelines on new assessment and test methods (NATM) and in Regulation (EU) 2022/1426, annex
III, part 4. Nothing here is judged against a limit: that is the assessor's.
"""

from __future__ import annotations

from collections.abc import Iterable
from os import PathLike
from pathlib import Path

from avtorch.gap.quantity import unit_of, words_of
from avtorch.gap.result import sentences
from avtorch.gap.result.budget import percent as share_of
from avtorch.gap.result.diagnosis import Diagnosis
from avtorch.gap.result.manoeuvres import manoeuvres
from avtorch.report.diagnosis_tables import BAND, budget_table, candidate_table, manoeuvre_table, measure_table
from avtorch.report.page import Origin, Page, Section, markdown, written
from avtorch.report.table import Table

_NO_CLAIM = "This page lists what one run found. It claims no compliance with a regulation or a standard."
_ASSUMED = (
    "The car moves along its lane: steering, tyres at their limit, and the suspension are not modelled.",
    "A command is a demanded acceleration and holds until the next one; the car answers with a lag T_L and a gain K_L, "
    "and with the effects named on this page.",
    "What commands, speed and place do not predict is noise, of a spectrum fitted with each hypothesis.",
    "Parameters have the priors that are printed beside each effect in avtorch's documentation.",
)
_SILENT = (
    "Management of models, data and people: releases, training, who approved what.",
    "Verification of the simulator's code and of its numerical solution: only its output is compared here.",
    "Sensors, traffic, weather, and every other part of a toolchain beside the longitudinal response of the car.",
    "Fitness for a purpose: which error is small enough is stated by whom the simulation serves.",
    "Driving outside the ranges under Scope of validity: nothing was compared there.",
)
_HEADINGS = (
    ("Capability; analysis and description", "Scope of validity, Assumptions, Limits"),
    ("Accuracy; validation", "Data, Discrepancies explained, Unexplained rest, What was changed, Manoeuvres"),
    ("Uncertainty", "Uncertainty of parameters"),
    ("Correctness; verification", "not by this run"),
    ("Usability; management of models and data", "versions and hashes at the foot; the rest not by this run"),
    ("Fitness for purpose", "not by this run"),
)


def credibility_page(found: Diagnosis, *, quality: Iterable[str] = ()) -> Page:
    """The page. `quality`: notes from reading the data, one line each."""
    log, held = found.log, found.shrinkage
    sections = (
        _scope(found),
        _data(found, tuple(quality)),
        Section("Assumptions", items=(*_ASSUMED, *_tried(found))),
        _explained(found),
        _rest(found),
        _uncertainty(found),
        Section(
            "What was changed, and what it did on unseen data",
            tuple(sentences.budget(found)) or tuple(sentences.shrinkage(found)) or ("Nothing was changed.",),
            tables=() if held is None else (measure_table(held),),
            soft=("The changed simulator is in plant.toml.",) if found.plant is not None else (),
        ),
        _manoeuvres(found),
        Section("Limits", items=(*found.winner.implausible, *found.notes)),
        Section("What this run cannot say", items=_SILENT),
        Section(
            "Where an assessor's headings are answered",
            tables=(
                Table("Headings of NATM and of (EU) 2022/1426, annex III, part 4", ("heading", "here"), _HEADINGS),
            ),
        ),
    )
    of = f"{log.name} · {log.seconds:.0f} s at {log.rate_hz:.3g} Hz"
    lead = Section(sentences.headline(found), (_NO_CLAIM, *_in_short(found)))
    return Page("Evidence for a credibility assessment", of, lead, sections)


def write_credibility(
    found: Diagnosis, folder: str | PathLike[str], *, quality: Iterable[str] = (), origin: Origin | None = None
) -> list[Path]:
    """Write `credibility.html` and `credibility.md`; returns their paths. Raises `InputError` where they cannot be
    written.

    Example:
        >>> from avtorch import Leader, diagnose, simulate
        >>> from avtorch.gap import DeadTime, plant
        >>> from avtorch.report import write_credibility
        >>> late = plant([DeadTime(0.4)], sigma=0.0)
        >>> log = simulate(Leader.default(start=50.0, duration=14.0, dt=0.1), plant=late).log()
        >>> found = diagnose(log, effects=["dead_time"], pairs=False)
        >>> [path.name for path in write_credibility(found, "out")]
        ['credibility.html', 'credibility.md']
    """
    page = credibility_page(found, quality=quality)
    texts = {"credibility.html": page.html(origin), "credibility.md": markdown(page, origin)}
    return [written(text, folder, name) for name, text in texts.items()]


def _in_short(found: Diagnosis) -> list[str]:
    budget = found.budget
    if budget is None:
        return ["The drives are too short to hold parts of them out: nothing here was tried on unseen data."]
    units = {"speed": "m/s", "accel": "m/s²"}
    errors = [f"{name} {e.before:.2g} {units[name]}, now {e.left:.2g}" for name, e in budget.by_channel.items()]
    return [f"RMS error of {budget.horizon_s:.3g} s simulations on unseen parts of the drive: {'; '.join(errors)}."]


def _scope(found: Diagnosis) -> Section:
    log, traces = found.log, found.traces
    rows = []
    for name, ends, unit in (("speed", log.speeds, "m/s"), ("command", log.commands, "m/s²")):
        rows.append((name, "not in the log" if ends is None else f"{ends[0]:.3g} to {ends[1]:.3g} {unit}"))
    if traces is not None and traces.speed is not None:
        rows.append(("road driven while it counted", f"{traces.speed.sum() * traces.step / 1000:.2f} km"))
    rows.append(("slope of the road", "measured" if "grade" in log.signals else "not measured; part of what is fitted"))
    rows.append(("signals", ", ".join(log.signals)))
    said = ("Speeds leave out the slowest and the fastest hundredth of the rows.",)
    return Section(
        "Scope of validity", tables=(Table("What the drives covered", ("quantity", "covered"), tuple(rows)),), soft=said
    )


def _data(found: Diagnosis, quality: tuple[str, ...]) -> Section:
    log, held, traces = found.log, found.shrinkage, found.traces
    lines = [f"{log.rows} rows in {log.segments} segment{'s' * (log.segments != 1)}, {log.seconds:.0f} s in all."]
    if traces is not None:
        lines.append(f"{len(traces.time) * traces.step:.0f} s counted.")
        for why in dict.fromkeys(x.why for x in traces.uncounted):
            lines.append(f"{sum(x.end - x.begin for x in traces.uncounted if x.why == why):.0f} s did not: {why}.")
    if held is None:
        lines.append("Nothing was held out.")
    else:
        what = "whole drives" if held.by_drives else "blocks of the drive"
        lines.append(f"Held out in turn: {held.blocks} {what}; each is predicted by parameters fitted without it.")
        lines.append("Which causes are named was decided on all of the data.")
    return Section("Data used and held out", (" ".join(lines),), items=quality)


def _tried(found: Diagnosis) -> list[str]:
    base = ", ".join(f"{name} {q.mean:.3g}" for name, q in found.baseline.items())
    lines = [f"The baseline simulator, fitted to these drives without any effect: {base}."]
    if found.scope is not None:
        lines.append(
            f"Causes that were looked for: {', '.join(found.scope.scored)}; several at once: {found.scope.pairs}."
        )
    return lines


def _explained(found: Diagnosis) -> Section:
    budget = found.budget
    table = candidate_table(found, most=8) if budget is None else budget_table(budget, found.log.epochs_s[0])
    lines = (sentences.aliases(found), *sentences.onset(found), *sentences.where(found), *sentences.moved(found))
    return Section("Discrepancies explained", lines, tables=(table,), soft=(found.verdict.why,))


def _rest(found: Diagnosis) -> Section:
    budget = found.budget
    if budget is None:
        return Section("Unexplained rest", ("Not known: nothing was held out.",))
    rest, says = budget.unexplained, []
    share = rest.share
    says.append(
        f"Unexplained share of the gap: {share_of(share.mean)} ({100 * share.q05:.0f} to {100 * share.q95:.0f} %), "
        f"{'enough to matter' if rest.material else 'less than was said to matter'} (from {share_of(budget.material)})."
        if budget.parts
        else f"Of the baseline's squared error {share_of(budget.left_above_noise)} is above what noise alone makes."
    )
    says.append(f"Beyond that the error is {rest.rest(budget.material)}.")
    if places := rest.places(found.log.epochs_s[0]):
        says.append(f"It lies {places}.")
    return Section("Unexplained rest", tuple(says))


def _uncertainty(found: Diagnosis) -> Section:
    rows = []
    for row in found.summary().rows():
        name = str(row["parameter"]).rpartition(".")[2]
        numbers = (f"{row[key]:.3g}" for key in ("mean", "sd", "q05", "q95"))
        rows.append((words_of(name), row["parameter"], *numbers, unit_of(name)))
    says = "Of the repaired simulator" if found.belief else "Of the baseline simulator"
    titles = ("parameter", "name", "mean", "standard deviation", "5 %", "95 %", "unit")
    return Section(
        "Uncertainty of parameters",
        (f"{says}, given that it has the form found here; that the form is right is under Discrepancies explained.",),
        tables=(Table("Posterior", titles, tuple(rows), numeric=titles[2:6]),),
    )


def _manoeuvres(found: Diagnosis) -> Section:
    if found.traces is None:
        return Section("Manoeuvres")
    table = manoeuvre_table(found, manoeuvres(found.traces, named=bool(found.winner.effects)))
    said = (
        f"A band of ±x about the measured acceleration holds {100 * BAND:.0f} % of the simulated rows of a manoeuvre. "
        "ISO 19364 compares by bands of tolerance, which it states for steering; none is applied here."
    )
    return Section("Manoeuvres", (said if table.rows else "None was recognised.",), tables=(table,))
