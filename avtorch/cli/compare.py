"""`avtorch compare`: did a change to the car or to the simulator help?"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from avtorch.cli import arguments as arg
from avtorch.cli.simulators import read_simulator, simulator_of, simulators_of
from avtorch.cli.talk import Talk, write_answer
from avtorch.errors import InputError

if TYPE_CHECKING:
    from avtorch.external import SimulatorComparison
    from avtorch.gap.result.comparison import Comparison
    from avtorch.io import Log

PAGE = "comparison.html"


def compare(
    logs: list[Path],
    /,
    *,
    after: Annotated[
        list[Path] | None, arg.option("The drives after the change; all of LOGS are before it.", consume_multiple=True)
    ] = None,
    simulator: Annotated[
        list[str] | None,
        arg.option("A simulator: MODULE:NAME, FILE.py:NAME or an FMU; effects such as dead_time=0.2, or TOML."),
    ] = None,
    simulated: Annotated[
        list[str] | None,
        arg.option("A simulator by its output: a file, or the prefix of columns of the log, such as sim."),
    ] = None,
    step: Annotated[
        float | None, arg.above_zero("The simulators' own step [s], if they take no other; default: the log's.", "s")
    ] = None,
    baseline: Annotated[
        str, arg.option("The simulator: effects such as dead_time=0.2, or TOML; glvd: fitted to the drives before.")
    ] = "glvd",
    baseline_after: Annotated[str | None, arg.option("The simulator of the drives after; default: the same.")] = None,
    out: Annotated[
        Path | None,
        arg.option("Folder for comparison.html and .json.", arg.OUTPUT, name="--out", converter=arg.local_folder),
    ] = None,
    map: arg.Columns = None,
    unit: arg.Units = None,
    open_page: arg.Open = False,
    json: arg.Json = False,
    quiet: arg.Quiet = False,
) -> None:
    """Did a change to the car, or to the simulator, help? By how much, with intervals.

    Two simulators and one log: which is nearer to the car, and by what.

    Parameters
    ----------
    logs
        Logs, as for diagnose: the drive before the change and the one after it; with --after any number before it; with
        two simulators a single one.
    """
    given = dict(locals())
    if open_page and out is None:
        raise InputError("--open: found without --out; needs a folder for the page")
    two = [*(simulator or ()), *(simulated or ())]
    before, later = (logs, after) if after else (logs[:1], logs[1:])
    if len(later) > 1 and not after:
        raise InputError(f"LOGS: found {len(logs)}, needs two; with more, say --after before those after the change")
    if two and (baseline != "glvd" or baseline_after is not None):
        raise InputError("--baseline: found beside --simulator or --simulated, needs the plant as --simulator")
    talk = Talk(json=json, quiet=quiet)
    found: Comparison | SimulatorComparison
    if later:
        if len(simulator or ()) > 1:
            raise InputError(f"--simulator: found {len(two)} beside several logs, needs one, or one log")
        base = read_simulator("--baseline", baseline)
        other = None if baseline_after is None else read_simulator("--baseline-after", baseline_after)
        if baseline_after is not None and (base is None or other is None):
            needs = "needs --baseline and --baseline-after given"
            raise InputError(f"--baseline-after: found without two simulators; {needs}")

        from avtorch.gap.compare import compare as work

        sides = [[_log(path, map, unit, talk) for path in paths] for paths in (before, later)]
        read = [*sides[0], *sides[1]]
        drives = list(zip([*before, *later], read, strict=True))
        own = simulator_of(simulated or (), (simulator or (None,))[0], step, drives)
        with talk.progress("Comparing") as step_done:
            found = work(*sides, baseline=own or base, baseline_after=other, progress=step_done)
    else:
        if not two:
            needs = "needs a file, or two of --simulator and --simulated, see avtorch compare --help"
            raise InputError(f"AFTER: missing; {needs}")
        if len(two) != 2:
            raise InputError(f"--simulator, --simulated: found {len(two)} beside one log, needs two")

        from avtorch.external import compare_simulators

        read = [_log(logs[0], map, unit, talk)]
        first, second = simulators_of(simulator or (), simulated or (), step, logs[0], read[0])
        with talk.progress("Comparing") as step_done:
            found = compare_simulators(read[0], first, second, progress=step_done)
        for which in (x for x in (found.first, found.second) if x.notes):
            talk.notes(which.name, which.notes)

    from avtorch.io import check
    from avtorch.report.comparison import comparison_html, comparison_tables

    if out is not None:
        notes = [f"{log.name}: {note}" for log in read for note in check(log).notes]
        origin = arg.origin_of([*before, *later, *_files([*two, baseline, baseline_after or ""])], given)
        pages = {PAGE: lambda: comparison_html(found, notes=notes, origin=origin)}
        write_answer(out, "comparison.json", found.to_dict(), pages=pages)
        if open_page:
            talk.show(out / PAGE)
    talk.lines([found.why, ""], "bold")
    for table in () if talk.silent else comparison_tables(found):
        talk.table(table)
    if out is not None:
        talk.done(out, found.to_dict())
    elif talk.json:
        talk.answer(found.to_dict())


def _files(sources: Sequence[str]) -> list[Path]:
    """Those of a simulator's sources that are files: a module or a list of effects is none."""
    names = [source.rpartition(":")[0] if ".py:" in source else source for source in sources]
    return [Path(name) for name in names if name and Path(name).is_file()]


def _log(path: Path, map: list[str] | None, unit: list[str] | None, talk: Talk) -> Log:
    from avtorch.io import Log, check
    from avtorch.io.quality import require_usable

    log = Log.read(path, map=map, unit=unit)
    require_usable(log)
    talk.notes(log.name, check(log).notes)
    return log
