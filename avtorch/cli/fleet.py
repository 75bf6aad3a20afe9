"""`avtorch fleet`: many logs at once, on this machine or on a cluster."""

from __future__ import annotations

import os
from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Group

from avtorch.cli import arguments as arg
from avtorch.cli.diagnose import chosen_effects
from avtorch.cli.simulators import read_simulator
from avtorch.cli.talk import Talk
from avtorch.errors import InputError, quoted

if TYPE_CHECKING:
    from avtorch.fleet.cluster import Cluster
    from avtorch.fleet.settings import Step

CLUSTER = Group("Cluster", sort_key=8)
SHOWN = 20
"""Cars in the printed table; all of them are in the answer."""


def fleet(
    logs: list[str],
    /,
    *,
    out: arg.Out,
    only: Annotated[
        str | None, arg.option("Only these steps, STEP,STEP of check, estimate and diagnose; default: all.")
    ] = None,
    map: arg.Columns = None,
    unit: arg.Units = None,
    stamp: arg.Stamps = None,
    window: arg.Window = 2.0,
    estimator: arg.Estimator = "auto",
    tau: arg.TimeGap = 1.0,
    gains: arg.Gains = "1.5,1.5,-0.8",
    accepted: arg.Accepted = "0.3,1.0",
    dead_time: arg.DeadTime = None,
    target: Annotated[float, arg.option("A car with a lower P(string stable) comes first.")] = 0.9,
    baseline: arg.Baseline = "glvd",
    effects: arg.Effects = None,
    pairs: arg.Pairs = True,
    budget: arg.Budget = None,
    reports: Annotated[bool, arg.option("Write the report of each diagnosed log, and link to it.", arg.OUTPUT)] = False,
    retry: Annotated[bool, arg.option("Try logs again that failed in an earlier run.")] = False,
    workers: Annotated[
        int | None,
        arg.whole("Processes on this machine, one thread each; default: one a core.", least=1, group=CLUSTER),
    ] = None,
    memory: Annotated[str, arg.option("Most memory of each of them.", CLUSTER)] = "2GiB",
    scheduler: Annotated[
        str | None, arg.option("Address of a running Dask scheduler, such as tcp://10.0.0.1:8786.", CLUSTER)
    ] = None,
    seed: arg.Seed = 0,
    open_page: arg.Open = False,
    json: arg.Json = False,
    quiet: arg.Quiet = False,
) -> None:
    """Check, estimate and diagnose the logs of many cars; which car to look at first.

    The answer is fleet.html, a page for any browser, and fleet.json. Rows are written to --out as they come, as
    Parquet: checks, windows and diagnoses. Give the command again after an
    interruption, or with more logs: it does what is missing. A log that fails has a row that says why.

    Parameters
    ----------
    logs
        Files, a glob in quotes, a folder with all below it, URLs such as s3://bucket/logs, or a manifest: a CSV file
        with the columns log, car, and if wanted date and others.
    """
    steps = chosen_steps(only)
    k = arg.three_gains(gains)
    sound = arg.accepted_pair(accepted)
    if scheduler is not None and workers is not None:
        raise InputError("--workers: found beside --scheduler, whose workers are its own; needs one of the two")

    from avtorch.fleet.cluster import memory_bytes, require_dask

    require_dask()
    memory_bytes(memory)
    known = chosen_effects(effects)
    # not for the default, which needs no torch
    assumed = None if baseline == "glvd" else read_simulator("--baseline", baseline)

    from avtorch.fleet import FleetSettings, find_logs, run_fleet
    from avtorch.report import Origin, write_fleet_page
    from avtorch.report.fleet import many

    page = None
    if reports:
        from avtorch.report.diagnosis import report_html as page

    settings = FleetSettings(
        steps=steps,
        map=tuple(map or ()),
        unit=tuple(unit or ()),
        stamp=tuple(stamp or ()),
        window=window,
        estimator=estimator,
        time_gap=tau,
        gains=k,
        accepted=sound,
        dead_time=dead_time,
        baseline="glvd" if assumed is None else assumed.to_toml(),
        effects=None if known is None else tuple(known),
        pairs=pairs,
        budget_s=budget,
        target=target,
        seed=seed,
    )
    talk = Talk(json=json, quiet=quiet)
    found = find_logs(logs, leave_out=out)
    cars = len({log.car for log in found.logs})
    talk.line(f"{many(len(found.logs), 'log')} of {many(cars, 'car')}, {_CAR_FROM[found.car_from]}")

    def tell(cluster: Cluster) -> None:
        if cluster.dashboard is not None:
            talk.line(f"Dask's dashboard: {cluster.dashboard}")

    try:
        with talk.progress("Fleet") as step:
            answer = run_fleet(
                found,
                out,
                settings=settings,
                workers=workers,
                memory=memory,
                scheduler=scheduler,
                retry=retry,
                report=page,
                progress=step,
                connected_to=tell,
            )
    except KeyboardInterrupt:
        raise KeyboardInterrupt(f"finished rows are kept in {out}: the same command does what is missing") from None
    page_path = write_fleet_page(answer, out, origin=Origin.of(arg.COMMAND_LINE.get(), settings=asdict(settings)))
    if open_page:
        talk.show(page_path)
    if talk.json:
        talk.answer(answer)
        return
    _print(talk, answer)
    talk.line(f"\nWritten to {out}: fleet.html, fleet.json and the rows in checks, windows and diagnoses (Parquet)")


_CAR_FROM = {
    "manifest": "named by the manifest",
    "folder": "each named by the folder of its logs",
    "file": "each named by its file, as all logs lie in one folder",
}


def chosen_steps(text: str | None) -> tuple[Step, ...]:
    """The steps of `--only`. Raises `InputError` for others."""
    from avtorch.fleet.settings import STEPS

    if text is None:
        return STEPS
    names = {part.strip() for part in text.split(",")}
    if not names <= set(STEPS):
        raise InputError(f"--only: found {quoted(text)}, needs some of {', '.join(STEPS)}")
    return tuple(step for step in STEPS if step in names)


def _print(talk: Talk, answer: dict[str, Any]) -> None:
    """The first cars, in the order in which to look at them, and what failed."""
    from avtorch.report.fleet import failure_table, many, ranking_table

    if talk.silent:
        return
    talk.table(ranking_table(answer["cars"]), most=SHOWN)
    failures = failure_table(answer).rows
    for place, _, _, why in failures[:5]:
        talk.line(f"Failed: {why if place in why or os.path.basename(place) in why else f'{place}: {why}'}")
    if len(failures) > 5:
        talk.line(f"... and {many(len(failures) - 5, 'more log')} failed, see fleet.json")
    for note in answer["notes"]:
        talk.line(note)
    done = answer["work"]
    talk.line(f"\n{many(done['computed'], 'answer')} computed, {done['kept']} kept from earlier runs.")
