"""`avtorch estimate`: the belief on a recorded log."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter

from avtorch.cli import arguments as arg
from avtorch.cli.pedals import commanded, write_pedals
from avtorch.cli.talk import Talk, write_answer
from avtorch.errors import InputError

PAGE = "estimates.html"
STATE = "windows.state"
"""Finished windows, and the belief behind them. The estimate keeps them and compares what they belong to with its
settings."""
PASSING_ON = ("auto", "sgld", "importance", "map")
"""Estimators whose posteriors become priors, so that `--mode` has a meaning."""


def estimate(
    log: Path,
    *,
    window: arg.Window = 2.0,
    out: arg.Out,
    map: arg.Columns = None,
    unit: arg.Units = None,
    stamp: arg.Stamps = None,
    form: arg.Form = "auto",
    estimator: arg.Estimator = "auto",
    mode: arg.Mode = "lambda",
    tau: arg.TimeGap = 1.0,
    gains: arg.Gains = "1.5,1.5,-0.8",
    accepted: arg.Accepted = "0.3,1.0",
    dead_time: arg.DeadTime = None,
    align: Annotated[
        bool, Parameter(help="Where accel and speed differ by a clock or a filter, put the late one on time.")
    ] = True,
    resume: Annotated[bool, Parameter(help="Resume an interrupted run in --out, or start again.")] = True,
    seed: arg.Seed = 0,
    open_page: arg.Open = False,
    json: arg.Json = False,
    quiet: arg.Quiet = False,
) -> None:
    """Estimate the vehicle's actuation, lag and gain, from a recorded drive, window by window.

    A check of the log comes first. Then one posterior of (T_L, K_L) per window, alerts, and P(string stable) under the
    controller named by --tau and --gains, which a log does not hold. Give the command again to resume a run that was
    interrupted.

    Parameters
    ----------
    log
        A table of text, Parquet or a recording: time, accel_cmd, and accel or speed. avtorch check LOG finds names and
        units and writes LOG.toml beside it. Without accel_cmd a map is made of throttle, brake, torque or current,
        which needs speed.
    """
    given = dict(locals())
    k = arg.three_gains(gains)
    sound = arg.accepted_pair(accepted)
    if mode != "lambda" and estimator not in PASSING_ON:
        raise InputError(f"--mode: has no meaning with --estimator {estimator}, which passes no prior on; leave it out")

    from avtorch.decision.estimation import estimate as work
    from avtorch.decision.settings import Setting
    from avtorch.io import Log, check
    from avtorch.io.clock import from_start
    from avtorch.results import estimates_answer

    talk = Talk(json=json, quiet=quiet)
    drive = Log.read(log, map=map, unit=unit, stamp=stamp)
    talk.notes(f"{drive.name}", check(drive).notes)
    (drive,), fit, about_map = commanded(talk, [drive])
    setting = Setting(time_gap=tau, gains=k, scenarios=1)
    if not resume:
        _begin_anew(out / STATE)
    options: dict[str, Any] = {"mode": mode} if estimator in PASSING_ON else {}
    options |= {"form": form, "setting": setting, "dead_time": dead_time, "seed": seed, "accepted": sound}
    options |= {"estimator": estimator, "align": align, "checkpoint": out / STATE}
    try:
        with talk.progress("Estimating") as step:
            found = work(drive, window, progress=step, **options)
    except KeyboardInterrupt:
        if (out / STATE).exists():
            kept = f"finished windows are kept in {out / STATE}: the same command resumes there"
            raise KeyboardInterrupt(kept) from None
        raise
    answer = estimates_answer(found)
    if fit is not None:
        answer["command"] = about_map

    from avtorch import plots
    from avtorch.report.estimates import (
        P_WORDS,
        alert_table,
        dead_time_note,
        estimates_html,
        estimates_note,
        late_note,
        window_table,
    )

    origin = arg.origin_of([log], given)
    notes = () if fit is None else (about_map,)
    pictures = {
        "belief.png": lambda: plots.belief_figure(answer, log=drive),
        "probability.png": lambda: plots.probability_figure(answer),
    }
    pages = {PAGE: lambda: estimates_html(found, drive, notes=notes, origin=origin)}
    pedals = lambda staged: write_pedals(fit, staged)  # noqa: E731
    write_answer(out, "estimates.json", answer, pictures, pages, more=pedals)
    if open_page:
        talk.show(out / PAGE)
    printed = answer | {key: from_start(answer[key], answer["epoch_s"]) for key in ("windows", "alerts")}
    talk.table(window_table(printed["windows"]), most=60)
    talk.lines([P_WORDS], "dim")
    talk.lines([estimates_note(answer)])
    talk.table(alert_table(printed["alerts"]))
    more = (late_note(found.late), dead_time_note(found.inferred), answer["estimator_note"])
    talk.lines([text for text in more if text])
    talk.done(out, answer)


def _begin_anew(path: Path) -> None:
    """Remove what is kept there. Raises `InputError` where something else has such a name."""
    try:
        path.unlink(missing_ok=True)
    except OSError as fault:
        raise InputError(f"--no-resume: {path} cannot be removed ({fault.strerror}); needs another folder") from None
