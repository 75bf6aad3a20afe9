"""`avtorch diagnose`: which effect the simulator lacks, by one or more logs of a car, or of a car that follows."""

from __future__ import annotations

import inspect
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import Group

from avtorch.cli import arguments as arg
from avtorch.cli.pedals import commanded, write_pedals
from avtorch.cli.simulators import read_simulator, refuse_loop, simulator_of
from avtorch.cli.talk import Talk
from avtorch.errors import InputError, quoted
from avtorch.numeral import numeral

if TYPE_CHECKING:
    from avtorch.experiment import Limits
    from avtorch.gap.result.diagnosis import Diagnosis
    from avtorch.gap.result.traces import Alarm
    from avtorch.io import Log
    from avtorch.report.table import Table

TRACK = Group("Next experiment", sort_key=20)
TESTED = Group("A simulator of your own", sort_key=19)
FOLLOWER = Group("Car following", sort_key=21)
CAUSES = ("none", "unknown", "pair")
"""Hypotheses besides the effects that a prior may weigh; `pair`: all pairs together."""
PAGE = "report.html"
OF_FOLLOWER = ("vehicle", "law", "event")
"""Options that only --follower has a use for."""
WITH_FOLLOWER = ("logs", "out", "map", "unit", "stamp", "effects", "seed", "open_page", "verbose", "json", "quiet")
"""Those besides them that have a meaning with it."""


def diagnose(
    logs: list[Path],
    /,
    *,
    out: arg.Out,
    map: arg.Columns = None,
    unit: arg.Units = None,
    stamp: arg.Stamps = None,
    baseline: arg.Baseline = "glvd",
    simulated: Annotated[
        list[str] | None,
        arg.option(
            "Its output under the same commands, one file for each log; or the prefix of the log's "
            "own columns that hold it, such as sim. for sim.speed; repeatable.",
            TESTED,
        ),
    ] = None,
    simulator: Annotated[
        str | None,
        arg.option(
            "The simulator itself: an FMU, or MODULE:NAME or FILE.py:NAME with reset(speed, accel) "
            "and step(accel_cmd, dt).",
            TESTED,
        ),
    ] = None,
    step: Annotated[
        float | None, arg.above_zero("The simulator's own step [s]; default: the log's.", "s", group=TESTED)
    ] = None,
    adjust: Annotated[
        list[str] | None,
        arg.option(
            "A parameter of the simulator that may be wrong, NAME=LOW:HIGH, such as lag=0.1:1.0; repeatable.", TESTED
        ),
    ] = None,
    rollouts: Annotated[
        int | None, arg.option("How often the simulator may be driven along the logs for that; default: 50.", TESTED)
    ] = None,
    processes: Annotated[int, arg.option("How many of these drives at once, for a slow simulator.", TESTED)] = 1,
    prior: Annotated[
        list[str] | None,
        arg.option("Prior weight of a hypothesis, NAME=WEIGHT (effect, none, unknown, pair); repeatable."),
    ] = None,
    accel_kind: Annotated[
        Literal["kinematic", "specific-force"],
        arg.option("What accel is: dv/dt, or an accelerometer's reading of specific force."),
    ] = "kinematic",
    budget: arg.Budget = None,
    material: Annotated[float, arg.option("Share of the gap from which something counts, between 0 and 1.")] = 0.03,
    effects: arg.Effects = None,
    pairs: arg.Pairs = True,
    named_only: Annotated[
        bool, arg.option("The repaired simulator has named effects alone, no map without a name.")
    ] = False,
    posterior: Annotated[
        Literal["laplace", "sgld"], arg.option("Posterior of the winner's parameters: normal approximation, or SGLD.")
    ] = "sgld",
    estimates: Annotated[
        list[Path] | None,
        arg.option(
            "estimates.json of avtorch estimate on the same log, whose alarms the report marks; one for each log."
        ),
    ] = None,
    credibility: Annotated[
        bool, arg.option("Also write credibility.html and .md, the evidence for an assessor.", arg.OUTPUT)
    ] = False,
    follower: Annotated[bool, arg.option("The log is of a car that follows, and has no accel_cmd.", FOLLOWER)] = False,
    vehicle: Annotated[int | None, arg.option("Which vehicle of an OpenACC platoon.", FOLLOWER)] = None,
    law: Annotated[
        Literal["constant_time_gap", "intelligent_driver"] | None,
        arg.option("The assumed controller; default: the one that predicts better.", FOLLOWER),
    ] = None,
    event: Annotated[int | None, arg.option("Which event of an NGSIM file.", FOLLOWER)] = None,
    speed_min: Annotated[
        float | None, arg.option("Lowest speed of the next experiment [m/s]; default: as in the log.", TRACK)
    ] = None,
    speed_max: Annotated[float | None, arg.option("Highest speed [m/s]; default: as in the log.", TRACK)] = None,
    accel_min: Annotated[
        float | None, arg.option("Hardest braking [m/s²], below 0; default: as in the log.", TRACK)
    ] = None,
    accel_max: Annotated[
        float | None, arg.option("Hardest acceleration [m/s²]; default: as in the log.", TRACK)
    ] = None,
    road: Annotated[float | None, arg.option("Length of the road [m]; default: 2000.", TRACK)] = None,
    seconds: Annotated[float | None, arg.option("Duration [s]; default: 60.", TRACK)] = None,
    seed: arg.Seed = 0,
    open_page: arg.Open = False,
    verbose: arg.Verbose = False,
    json: arg.Json = False,
    quiet: arg.Quiet = False,
) -> None:
    """What does the simulator lack? Names the effect, its parameters, and what the log cannot distinguish.

    Writes diagnosis.json and plant.toml, the repaired simulator.

    Parameters
    ----------
    logs
        Tables of text, Parquet or recordings: time, accel_cmd, and accel or speed. Several are drives of one car.
        avtorch check LOG finds names and units and writes LOG.toml beside it. Without accel_cmd a map is made of
        throttle, brake, torque or current, which needs speed.
        With --follower: time, speed, spacing, lead_speed, or an OpenACC, NGSIM or I-24 file.
    """
    given = dict(locals())
    if not 0 < material < 1:
        raise InputError(f"--material: found {material:g}, needs a share between 0 and 1, such as 0.05")
    chosen = chosen_effects(effects)
    weights = _prior(prior or ())
    assumed = read_simulator("--baseline", baseline)
    if assumed is not None and (simulated or simulator is not None):
        raise InputError("--baseline: found beside --simulated or --simulator, needs one simulator")
    options = inspect.signature(diagnose).parameters
    changed = {name for name, value in given.items() if value != options[name].default}

    from avtorch.io import Log, check

    talk = Talk(json=json, quiet=quiet)
    if follower:
        if len(logs) > 1:
            raise InputError(f"--follower: found {len(logs)} logs, needs one at a time")
        for name in options:
            if name in changed - {"follower", *OF_FOLLOWER, *WITH_FOLLOWER}:
                negated = "no-" if given[name] is False else ""
                raise InputError(f"--{negated}{name.replace('_', '-')}: has no meaning with --follower")
        _follow(talk, given, chosen)
        if open_page:
            talk.show(out / PAGE)
        return
    for name in OF_FOLLOWER:
        if name in changed:
            raise InputError(f"--{name}: has a meaning with --follower only")
    read = [Log.read(path, map=map, unit=unit, stamp=stamp) for path in logs]
    refuse_loop(simulated, read)
    drives, fit, about_map = commanded(talk, read)
    with_paths = list(zip(logs, drives, strict=True))
    for path, drive in with_paths:
        _usable(path, drive, accel_kind, chosen or ())
    track = ("speed_min", "speed_max", "accel_min", "accel_max", "road", "seconds")
    limits = _limits(drives, {name: given[name] for name in track})
    alarms = read_alarms(estimates, drives) if estimates else ()
    own = simulator_of(
        simulated or (), simulator, step, with_paths, adjust=adjust or (), rollouts=rollouts, processes=processes
    )
    quality = []
    for drive in drives:
        noted = check(drive).notes
        if verbose:
            talk.notes(drive.name, noted)
        quality += [f"{Path(drive.name).name}: {note}" for note in noted]

    origin = arg.origin_of(
        [*logs, *([Path(baseline)] if baseline.endswith(".toml") else []), *(estimates or ())], given
    )
    from avtorch.gap.diagnose import diagnose as work

    with talk.progress("Diagnosing") as done:
        found = work(
            drives,
            baseline=own or assumed,
            prior=weights or None,
            accel_kind=accel_kind,
            effects=chosen,
            pairs=pairs,
            posterior=posterior,
            budget_s=budget,
            material=material,
            named_only=named_only,
            seed=seed,
            progress=done,
        )
    from avtorch.remedy import setting_for, write_exports

    setting = setting_for(found, [x for drive in drives if drive.accel_cmd is not None for x in drive.accel_cmd])
    from avtorch.experiment import next_experiment, write_table
    from avtorch.gap.result.diagnosis import DIAGNOSIS_FILES
    from avtorch.io import answer_set
    from avtorch.report import write_credibility, write_report

    notes = found.notes if fit is None else (*found.notes, about_map)
    try:
        ahead = next_experiment(found, limits, seed=seed)
    except InputError as error:  # this car within these limits: no reason to lose the answer
        ahead, notes = None, (*notes, f"No next experiment: {error}.")
    found = replace(
        found,
        notes=notes,
        alarms=alarms,
        setting=None if setting is None else setting.to_dict(),
        next_experiment=None if ahead is None else ahead.to_dict(),
    )
    with answer_set(out, DIAGNOSIS_FILES) as staged:
        found.write(staged)
        write_table(ahead, staged)
        write_exports(found.plant, staged, pedals=None if fit is None else fit.map)
        write_report(found, staged, quality=quality, experiment=ahead, origin=origin)
        if credibility:
            write_credibility(found, staged, quality=quality, origin=origin)
        write_pedals(fit, staged)
    if open_page:
        talk.show(out / PAGE)
    if not talk.json:
        print_diagnosis(talk, found, verbose=verbose)
    talk.done(out, found.to_dict())


def _follow(talk: Talk, given: Mapping[str, Any], effects: Sequence[str] | None) -> None:
    """Diagnose the follower as the arguments `given` say, write the answer and the page, and print a summary."""
    from avtorch.follower import diagnose_follower
    from avtorch.gap.result.diagnosis import DIAGNOSIS_FILES
    from avtorch.io import answer_set, check, read_following, write_json
    from avtorch.remedy import write_exports
    from avtorch.report import write_report

    path, out, verbose = given["logs"][0], given["out"], given["verbose"]
    log = read_following(path, **{name: given[name] for name in ("map", "unit", "stamp", "vehicle", "event")})
    noted = [*check(log).notes, *log.remarks]
    if verbose:
        talk.notes(log.name, noted)
    origin = arg.origin_of([path], given)
    with talk.progress("Diagnosing") as step:
        found = diagnose_follower(log, law=given["law"], effects=effects, seed=given["seed"], progress=step)
    gap = found.diagnosis
    assert gap is not None
    gap = replace(gap, notes=(*gap.notes, *found.conditional))
    lines = found.sentences()
    answer = replace(found, diagnosis=gap).to_dict()
    with answer_set(out, DIAGNOSIS_FILES) as staged:
        gap.write(staged)
        write_exports(gap.plant, staged)
        write_json(staged / "diagnosis.json", answer)
        write_report(gap, staged, quality=noted, sections={"The loop": lines}, origin=origin)
    if not talk.json:
        talk.lines(lines)
        talk.line("")
        talk.table(_loop_table(found.parameters))
        talk.line("Conditional on that law, on the held-out half of the drive:")
        print_diagnosis(talk, gap, verbose=verbose)
    talk.done(out, answer)


def _loop_table(parameters: Mapping[str, Any]) -> Table:
    from avtorch.gap.quantity import unit_behind, words_of
    from avtorch.report.table import Table

    rows = tuple(
        (words_of(name), f"{q.mean:.2f}{unit_behind(name)}", f"{q.q05:.2f} to {q.q95:.2f}")
        for name, q in parameters.items()
    )
    return Table("The loop", ("of the loop", "mean", "90 %"), rows)


def print_diagnosis(talk: Talk, found: Diagnosis, *, verbose: bool = False) -> None:
    """The verdict in one sentence and one table; the page's other sentences and tables where `verbose`."""
    from avtorch.gap.result import sentences
    from avtorch.report.diagnosis_tables import budget_table, candidate_table

    odd = found.winner.implausible
    known = {"unknown": "bold yellow", "none": "bold green"}
    talk.lines([sentences.headline(found)], "bold yellow" if odd else known.get(found.verdict.name, "bold cyan"))
    talk.lines(odd, "yellow")
    if not found.complete:
        text = "The budget ended the search: the answer is provisional; give the command a larger one."
        talk.lines([text], "yellow")
    budget = found.budget
    if verbose:
        talk.lines([*sentences.tested(found), *sentences.budget(found)])
        talk.lines([found.verdict.why], "dim")
    elif budget is not None and budget.rest:
        talk.lines([budget.rest])
    talk.line("")
    divided = budget is not None and (budget.parts or budget.chance or budget.unexplained.material)
    if budget is not None and divided:
        talk.table(budget_table(budget, found.log.epochs_s[0]))
    if verbose or not divided:
        talk.table(candidate_table(found, most=8 if verbose else 5))
    if verbose:
        talk.lines([sentences.aliases(found), *sentences.onset(found), *sentences.where(found)])
        talk.lines([*sentences.moved(found), *sentences.gap(found), *sentences.shrinkage(found)])
        talk.lines([*sentences.to_set(found), *sentences.to_drive(found), *sentences.remains(found)])
        talk.lines([note for note in found.notes if found.complete or "budget" not in note], "dim")
        talk.line("")


def _limits(drives: Sequence[Log], given: Mapping[str, float | None]) -> Limits:
    """Limits not given are taken from the log. Limits that allow no manoeuvre are refused before the search starts."""
    from avtorch.experiment import Limits, library
    from avtorch.gap.result.log_facts import LogFacts

    limits = Limits.of_log(LogFacts.of(drives), **given)
    if any(x is not None for x in given.values()) and not library(limits):
        raise InputError(
            "--speed-min, --speed-max, --accel-min, --accel-max, --road, --seconds: found limits that no manoeuvre of "
            "the library keeps to; needs more speed, effort, road or time"
        )
    return limits


def chosen_effects(text: str | None) -> list[str] | None:
    """The effects of `--effects`, None for all. Raises `InputError` for a name that is not known or comes twice."""
    if text is None:
        return None
    from avtorch.gap.simulator.effect import chosen_effects as known

    names = [part.strip() for part in text.split(",")]
    try:
        known(names)
    except InputError as fault:
        raise InputError(f"--effects: {str(fault).partition(': ')[2]}") from None
    return names


def _prior(given: Sequence[str]) -> dict[str, float]:
    from avtorch.gap.simulator.effect import effect_class

    weights: dict[str, float] = {}
    for item in given:
        name, equals, value = (x.strip() for x in item.partition("="))
        try:
            weight = numeral(value)
        except ValueError:
            weight = math.nan
        if not equals or not (math.isfinite(weight) and weight >= 0):
            raise InputError(
                f"--prior: found {quoted(item)}, needs NAME=WEIGHT with a number of 0 or more, such as none=5"
            )
        if name not in CAUSES:
            try:
                effect_class(name)
            except InputError as fault:
                raise InputError(f"--prior: {str(fault).partition(': ')[2]}, or {', '.join(CAUSES)}") from None
        if name in weights:
            raise InputError(f"--prior: found {name} twice, needs each name once")
        weights[name] = weight
    return weights


def _usable(path: Path, drive: Log, accel_kind: str, effects: Sequence[str]) -> None:
    """Raises `InputError` for a log without a row to use, and for options that its channels cannot answer."""
    from avtorch.gap import EFFECTS
    from avtorch.io.quality import require_usable

    require_usable(drive)
    if accel_kind == "specific-force" and drive.accel is None:
        raise InputError(f"--accel-kind: found specific-force, but {path} has no accel")
    for name in effects:
        for signal, needed in (("accel", EFFECTS[name].place == "sensor"), ("speed", EFFECTS[name].needs_speed)):
            if needed and getattr(drive, signal) is None:
                raise InputError(f"--effects: found {name}, which no log without {signal} can show, such as {path}")


_MOST_BYTES = 1 << 28
_NEED = "estimates.json, the answer of `avtorch estimate`"


def read_alarms(paths: Sequence[Path], logs: Sequence[Log]) -> tuple[Alarm, ...]:
    """The alarms in answers of `avtorch estimate`, one for each of the `logs` in their order.

    An alarm that goes on over many windows is one. Raises `InputError` for another number of files, one that is no such
    answer, or one on another log.
    """
    if len(paths) != len(logs):
        raise InputError(f"--estimates: found {len(paths)} for {len(logs)} logs, needs one for each, in their order")
    each = enumerate(zip(paths, logs, strict=True))
    return tuple(alarm for number, (path, log) in each for alarm in _alarms(path, log, number))


def _alarms(path: Path, log: Log, number: int) -> list[Alarm]:
    from avtorch.gap.result.traces import Alarm
    from avtorch.io.opening import place, read_regular

    try:
        answer = json.loads(read_regular(path, most=_MOST_BYTES, need=_NEED).decode("utf-8"))
        if answer["schema"] != "avtorch.estimates/1":
            raise InputError(f"{place(path)}: found {quoted(str(answer['schema']))} as its schema, needs {_NEED}")
        rows, epoch = int(answer["quality"]["rows"]), float(answer["epoch_s"])
        windows = [(float(w["end_s"]), frozenset(map(str, w["alerts"]))) for w in answer["windows"]]
    except InputError:
        raise
    except (KeyError, TypeError, ValueError, RecursionError) as fault:
        raise InputError(f"{place(path)}: is damaged or another file, needs {_NEED}") from fault
    if rows != log.rows or abs(epoch - log.epoch_s) > 1e-3:
        raise InputError(
            f"{place(path)}: is of a log of {rows} rows that begins at {epoch:.10g} s, needs the estimates of "
            f"{log.name}, {log.rows} rows from {log.epoch_s:.10g} s"
        )
    ended: tuple[float, frozenset[str]] = (0.0, frozenset())
    return [
        Alarm(end - epoch, detector, number)
        for (_, before), (end, now) in pairwise([ended, *windows])
        for detector in sorted(now - before)
    ]
