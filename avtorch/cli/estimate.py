"""`avtorch estimate`: the belief on a recorded log."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from cyclopts import Parameter

from avtorch.cli.arguments import (
    Gains,
    Json,
    Out,
    Quiet,
    Seed,
    TimeGap,
    free_folder,
    not_negative,
    positive,
    positive_pair,
    seed_number,
    three_gains,
)
from avtorch.cli.pedals import commanded, write_pedals
from avtorch.cli.talk import Talk, write_answer
from avtorch.errors import InputError


def estimate(
    log: Path,
    *,
    window: Annotated[float, Parameter(help="Length of a window [s].")] = 2.0,
    out: Out,
    map: Annotated[
        list[str] | None,
        Parameter(negative=(), help="Name of a column, SIGNAL=COLUMN, such as accel=ACC_X; repeatable."),
    ] = None,
    unit: Annotated[
        list[str] | None, Parameter(negative=(), help="Unit of a column, SIGNAL=UNIT, such as speed=km/h; repeatable.")
    ] = None,
    stamp: Annotated[
        list[str] | None, Parameter(negative=(), help="Own time column of a signal, SIGNAL=COLUMN; repeatable.")
    ] = None,
    form: Annotated[
        Literal["auto", "jerk", "latent"],
        Parameter(help="Likelihood: of measured jerk, or of noisy acceleration and speed."),
    ] = "auto",
    estimator: Annotated[
        Literal["sgld", "map", "rls", "ekf", "ukf"],
        Parameter(help="SGLD, posterior mode, recursive least squares, extended or unscented Kalman filter."),
    ] = "sgld",
    mode: Annotated[
        Literal["lambda", "posterior", "forgetting"],
        Parameter(help="How a posterior becomes the next prior (sgld and map)."),
    ] = "lambda",
    tau: TimeGap = 1.0,
    gains: Gains = "1.5,1.5,-0.8",
    accepted: Annotated[
        str, Parameter(help="    T_L,K_L of the car as it should be, which accepted_change compares with [s, -].")
    ] = "0.3,1.0",
    dead_time: Annotated[
        float, Parameter(help="Dead time of the car [s], if known; avtorch diagnose estimates it.")
    ] = 0.0,
    seed: Seed = 0,
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Estimate the vehicle's actuation, lag and gain, from a recorded drive, window by window.

    A check of the log comes first. Then one posterior of (T_L, K_L) per window, alerts, and P(string stable) under the
    controller named by --tau and --gains, which a log does not hold.

    Parameters
    ----------
    log
        CSV or Parquet: time, accel_cmd, and accel or speed. LOG.toml beside it may map names and units. Without
        accel_cmd a map is made of throttle, brake, torque or current, which needs speed.
    """
    positive("--window", window, "s")
    positive("--tau", tau, "s")
    k = three_gains("--gains", gains)
    sound = positive_pair("--accepted", accepted, "T_L,K_L", "0.3,1.0")
    not_negative("--dead-time", dead_time, "s")
    free_folder(out, without="run.json")
    seed_number(seed)
    if mode != "lambda" and estimator not in ("sgld", "map"):
        raise InputError(f"--mode: has no meaning with --estimator {estimator}, which passes no prior on; leave it out")

    from avtorch.decision.estimation import estimate as work
    from avtorch.decision.monitor import Monitor
    from avtorch.decision.settings import Setting
    from avtorch.io import Log, check
    from avtorch.io.clock import from_start
    from avtorch.results import estimates_answer

    talk = Talk(json=json, quiet=quiet)
    drive = Log.read(log, map=map, unit=unit, stamp=stamp)
    talk.notes(f"{drive.name}", check(drive).notes)
    (drive,), fit, about_map = commanded(talk, [drive])
    if estimator == "sgld" and (form == "latent" or drive.jerk is None or drive.accel is None):
        talk.sentence("The latent form, which needs no jerk, takes seconds a window; --estimator map takes a third.")
    setting = Setting(time_gap=tau, gains=k, scenarios=1)
    with talk.progress("Estimating") as step:
        options: dict[str, Any] = {"mode": mode} if estimator in ("sgld", "map") else {}
        options |= {"form": form, "setting": setting, "dead_time": dead_time, "seed": seed}
        options["monitor"] = Monitor(accepted=sound, dead_time=dead_time)
        found = work(drive, window, estimator=estimator, progress=step, **options)
    answer = estimates_answer(found)
    if fit is not None:
        answer["command"] = about_map

    from avtorch import plots

    pictures = {
        "belief.png": lambda: plots.belief_figure(answer["windows"], answer=answer, log=drive),
        "probability.png": lambda: plots.probability_figure(answer["windows"], answer=answer),
    }
    write_answer(out, "estimates.json", answer, pictures)
    write_pedals(fit, out)
    printed = answer | {key: from_start(answer[key], answer["epoch_s"]) for key in ("windows", "alerts")}
    talk.windows(printed["windows"])
    talk.summary(printed, estimates_note(answer))
    talk.done(out, answer)


UNEXPLAINED = 1.5
"""`Estimates.spread_ratio` above which a single lag and gain do not describe the log."""


def estimates_note(answer: Mapping[str, Any]) -> str:
    """Summarise a list of windows in one sentence."""
    windows = answer["windows"]
    excited, used = ([w for w in windows if w[key]] for key in ("excited", "used"))
    if not excited:
        longer = "use a longer --window" if len(windows) > 1 else "drive with more acceleration and braking"
        return f"{len(windows)} windows, none excited: the belief is still the first prior; {longer}."
    lost = len(excited) - len(used)
    count = f"{len(excited)} of {len(windows)} windows excited"
    if lost:
        what = "their chains" if answer.get("estimator", "sgld") == "sgld" else "the estimates"
        count += f", {lost} of them not used, as {what} did not converge"
    if not used:
        return f"{count}; the belief is still the first prior."
    last = used[-1]
    text = ", ".join(f"{name} {last[name]['mean']:.3f} ± {last[name]['sd']:.3f}" for name in ("T_L", "K_L"))
    spread = [f"{name} {x:.1f}" for name, x in answer["spread_over_sd"].items() if x is not None]
    more = f" Spread from window to window over posterior SD: {', '.join(spread)}." if spread else ""
    if any((x or 0.0) > UNEXPLAINED for x in answer["spread_over_sd"].values()):
        more += " Lag and gain alone do not explain this log, or they changed: find the cause with avtorch diagnose"
        more += " (pass a dead time with --dead-time)."
    elif all("accepted_change" in w["alerts"] for w in used):
        more += (
            " All of them differ from the accepted values: if the car is sound, pass its own with --accepted T_L,K_L."
        )
    return f"{count}; the last {'used' if lost else 'of them'} estimates {text}.{more}"
