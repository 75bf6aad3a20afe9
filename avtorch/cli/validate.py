"""`avtorch validate`: compare SGLD with exact quadrature and NUTS, on a log or on synthetic windows."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from avtorch.cli import arguments as arg
from avtorch.cli.talk import Talk, write_answer
from avtorch.errors import InputError

if TYPE_CHECKING:
    from arviz import InferenceData

PAGE = "validation.html"

#: Synthetic windows if no number is given.
SYNTHETIC = 200


def validate(
    log: Path | None = None,
    *,
    synthetic: Annotated[bool, arg.option("Windows of simulated vehicles, slow to quick, in place of a log.")] = False,
    windows: Annotated[
        int | None, arg.whole("Number of windows; 200 synthetic ones, or all of a log.", least=1)
    ] = None,
    window: arg.Window = 2.0,
    out: arg.Out,
    nuts_windows: Annotated[
        int | None, arg.whole("Number of windows that NUTS samples; 3, or 1 without jerk (minutes each).", least=1)
    ] = None,
    spread: Annotated[float, arg.zero_or_more("Posterior SDs around the mode at which chains start.")] = 0.0,
    chains: Annotated[int | None, arg.whole("SGLD chains per window.", least=1)] = None,
    draws: Annotated[int | None, arg.whole("Draws kept of each chain.")] = None,
    map: arg.Columns = None,
    unit: arg.Units = None,
    stamp: arg.Stamps = None,
    seed: arg.Seed = 0,
    open_page: arg.Open = False,
    json: arg.Json = False,
    quiet: arg.Quiet = False,
) -> None:
    """Do SGLD's posteriors agree with exact quadrature and with NUTS?

    Each window is estimated alone, under the first prior. Needs pip install 'avtorch[validate]'.

    Parameters
    ----------
    log
        A log, as for estimate. Without measured jerk there is no quadrature, and NUTS is the reference.
    """
    arguments = dict(locals())
    if synthetic and log is not None:
        raise InputError(f"--synthetic: found together with {log}; needs one of a log and --synthetic")
    if not synthetic and log is None:
        raise InputError("log: neither a log nor --synthetic was given; needs one of them")
    if synthetic and (map or unit or stamp):
        raise InputError("--map, --unit, --stamp: found with --synthetic; they name the columns of a log")

    from avtorch.validation.validate import check_installed

    check_installed()
    from avtorch.io import Log, check
    from avtorch.results import validation_answer
    from avtorch.validation import synthetic_windows, windows_of_log
    from avtorch.validation import validate as work

    given = {name: value for name, value in (("chains", chains), ("draws", draws)) if value is not None}
    talk = Talk(json=json, quiet=quiet)
    if log is None:
        source = synthetic_windows(SYNTHETIC if windows is None else windows, seed=seed)
    else:
        drive = Log.read(log, map=map, unit=unit, stamp=stamp)
        talk.notes(f"{drive.name}", check(drive).notes)
        source = windows_of_log(drive, window=window, count=windows)
    settings = replace(source.sampler, spread=spread, **given)
    with talk.progress("Validating") as step:
        found = work(source, settings=settings, nuts_windows=nuts_windows, seed=seed, progress=step)
    answer = validation_answer(found)
    origin = arg.origin_of([] if log is None else [log], arguments)

    from avtorch import plots
    from avtorch.report.validation import validation_html, validation_notes, validation_table

    groups = found.to_arviz()
    pages = {PAGE: lambda: validation_html(found, origin=origin)}
    nets = lambda staged: export(staged, groups)  # noqa: E731
    write_answer(out, "validation.json", answer, plots.validation_figures(found), pages, more=nets)
    if open_page:
        talk.show(out / PAGE)
    talk.table(validation_table(answer))
    talk.lines(validation_notes(answer), "dim")
    talk.lines([f"\n{answer['verdict']}: {answer['why']}"], "bold green" if found.verdict.agree else "bold red")
    talk.done(out, answer)
    talk.lines([f"For ArviZ: {', '.join(f'{name}.nc' for name in groups)}"])


def export(out: Path, groups: Mapping[str, InferenceData]) -> None:
    """Write each as NetCDF, `NAME.nc`. Raises `InputError` where that fails."""
    for name, group in groups.items():
        path = out / f"{name}.nc"
        try:
            group.to_netcdf(str(path))
        except (OSError, RuntimeError) as fault:  # what the libraries of NetCDF raise for a full disk
            reason = getattr(fault, "strerror", None) or str(fault)
            raise InputError(f"{path}: cannot be written ({reason})") from None
