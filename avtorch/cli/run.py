"""`avtorch run`: the closed loop with a change in the vehicle, watched and acted upon."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from avtorch.cli import arguments as arg
from avtorch.cli.talk import Talk, write_answer
from avtorch.errors import InputError

if TYPE_CHECKING:
    from avtorch.decision.strategist import Strategist
    from avtorch.decision.watch import SupervisedRun
    from avtorch.report import Origin
    from avtorch.vehicle import Block, ClosedLoop, Leader

DURATION_S = 80.0
HEALTHY = (0.3, 1.0)
BOUNDS = {"T_L": (0.1, 0.4), "K_L": (0.7, 1.0)}
"""The vehicle before the change, and what the controller was designed for (paper, Table 1)."""
PAGE = "run.html"


def run(
    *,
    leader: Annotated[Path | None, arg.option("Recorded leader (OpenACC, NGSIM, I-24, CSV); default US06.")] = None,
    vehicle: Annotated[int | None, arg.whole("Which vehicle of the leader's file.")] = None,
    event: Annotated[int | None, arg.whole("Which event of the leader's file (NGSIM).")] = None,
    duration: Annotated[
        float | None, arg.above_zero("Length of the run [s]; default 80, or the leader's.", "s")
    ] = None,
    window: arg.Window = 2.0,
    change_at: Annotated[float, arg.zero_or_more("When the vehicle changes [s].", "s")] = 26.0,
    T: Annotated[arg.Lag, arg.option("Actuation lag T_L from the change on [s].")] = 1.5,
    K: Annotated[arg.Gain, arg.option("Actuation gain K_L from the change on [-].")] = 0.5,
    strategy: Annotated[
        Literal["auto", "1", "2", "3", "none"],
        arg.option("What may change: 1 lower level, 2 time gap as well, 3 gains as well, auto any, none only watch."),
    ] = "auto",
    controller: Annotated[Literal["linear", "mpc"], arg.option("Upper level.")] = "linear",
    noise: Annotated[float, arg.zero_or_more("Jerk noise [m/s³].", "m/s³")] = 0.1,
    limits: Annotated[str, arg.option("Least and greatest command MIN,MAX [m/s²].")] = "-6,4",
    seed: arg.Seed = 0,
    out: arg.Out,
    open_page: arg.Open = False,
    json: arg.Json = False,
    quiet: arg.Quiet = False,
) -> None:
    """Simulate a follower whose vehicle changes: estimate, detect the change, act.

    The same drive without any action, under the same noise, stands beside it.
    """
    given = dict(locals())
    low, high = arg.limits_pair(limits)
    if controller == "mpc" and strategy == "3":
        raise InputError("--strategy: found 3 with --controller mpc, needs auto, 1, 2 or none")
    if leader is None and (vehicle is not None or event is not None):
        raise InputError("--vehicle, --event: choose within a file; --leader FILE is missing")

    from avtorch.vehicle import Leader

    ahead = Leader.default() if leader is None else Leader.read(leader, vehicle=vehicle, event=event)
    seconds = _length(duration, ahead)
    if change_at >= seconds:
        raise InputError(f"--change-at: found {change_at:g} s, needs to lie before the end of the run at {seconds:g} s")
    if window > seconds:
        raise InputError(f"--window: found {window:g} s, needs at most the length of the run, {seconds:g} s")

    from avtorch.decision.supervisor import Supervisor
    from avtorch.vehicle import MPC, ClosedLoop, GLVDPlant, LinearController, LowerLevel

    def fresh() -> ClosedLoop:
        upper = LinearController() if controller == "linear" else MPC(accel_min=low, accel_max=high)
        lower = LowerLevel(accel_min=low, accel_max=high)
        return ClosedLoop(ahead, upper, lower_level=lower, plant=GLVDPlant(*HEALTHY, sigma=noise), seeds=[seed])

    def change(loop: ClosedLoop) -> None:
        loop.plant = GLVDPlant(T, K, sigma=noise)

    talk = Talk(json=json, quiet=quiet)
    with talk.progress("Driving") as step:
        supervisor = Supervisor(fresh(), window=window, strategist=_strategist(strategy, controller), seed=seed)
        acting = supervisor.run(seconds, events=[(change_at, change)], progress=step)
        alone = acting.rows if strategy == "none" else _unwatched(fresh(), seconds, change_at, change)

    from avtorch.results import run_answer

    answer = run_answer(acting, alone, change=(change_at, T, K), time_gap=float(supervisor.default.time_gap[0]))
    origin = arg.origin_of([] if leader is None else [leader], given)
    _write(out, answer, acting, alone, acts=strategy != "none", vehicle=(T, K), change_at=change_at, origin=origin)
    if open_page:
        talk.show(out / PAGE)
    _print(talk, answer)
    talk.done(out, answer)


def _length(duration: float | None, leader: Leader) -> float:
    if duration is None:
        return min(DURATION_S, math.floor(leader.duration * 100 + 1e-6) / 100)
    if duration > leader.duration:
        raise InputError(
            f"--duration: found {duration:g} s, needs at most {leader.duration:g} s, all there is of {leader.name}"
        )
    return duration


def _strategist(strategy: str, controller: str) -> Strategist | None:
    from avtorch.decision.grid import Grid
    from avtorch.decision.strategist import Strategist
    from avtorch.decision.supervisor import ALLOWED
    from avtorch.vehicle import MPC

    if strategy == "none":
        return None
    if controller == "mpc":
        gains = lambda gap: MPC(time_gap=gap).gains  # noqa: E731
        return Strategist(Grid(allowed=ALLOWED[strategy] - {3}, gains_of_gap=gains))
    return Strategist(Grid(allowed=ALLOWED[strategy]))


def _unwatched(loop: ClosedLoop, seconds: float, change_at: float, change: Callable[[ClosedLoop], None]) -> Block:
    """The same drive without a monitor."""
    from avtorch.vehicle import Block

    turn, end = (round(time / loop.dt) for time in (change_at, seconds))
    blocks = [loop.advance(turn)] if turn else []
    change(loop)
    blocks += [loop.advance(end - turn)] if turn < end else []
    return Block.concatenate(blocks)


def _write(
    out: Path,
    answer: dict[str, Any],
    acting: SupervisedRun,
    alone: Block,
    *,
    acts: bool,
    vehicle: tuple[float, float],
    change_at: float,
    origin: Origin,
) -> None:
    from avtorch import plots
    from avtorch.report.run import run_html

    time, rows = acting.rows.time, acting.rows
    traces: dict[str, dict[str, Any]] = {}
    for quantity in ("speed", "accel", "spacing"):
        traces[quantity] = {"without action": getattr(alone, quantity)[0]}
        if quantity != "spacing":
            traces[quantity] = {"leader": getattr(rows, f"lead_{quantity}")[0], **traces[quantity]}
        if acts:
            traces[quantity]["with action"] = getattr(rows, quantity)[0]
    truth = {n: [(0.0, HEALTHY[i]), (change_at, vehicle[i])] for i, n in enumerate(("T_L", "K_L"))}
    settings, clouds = _moments(acting, change_at)
    pictures = {
        "overview.png": lambda: plots.overview_figure(answer, time, traces, truth=truth, bounds=BOUNDS),
        "motion.png": lambda: plots.motion_figure(answer, time, traces),
        "region.png": lambda: plots.region_figure(settings, clouds, truth=vehicle),
    }
    more: Any = {"truth": truth, "bounds": BOUNDS, "regions": (settings, clouds), "origin": origin}
    write_answer(out, "run.json", answer, pictures, {PAGE: lambda: run_html(answer, time, traces, **more)})


def _print(talk: Talk, answer: dict[str, Any]) -> None:
    """The events of a run in order, its windows, and how much the action helped."""
    from avtorch.report.estimates import P_WORDS, window_table
    from avtorch.report.run import collision, performance_table, story_table

    talk.table(window_table(answer["windows"]), most=60)
    talk.lines([P_WORDS, ""], "dim")
    talk.table(story_table(answer), most=12)
    talk.table(performance_table(answer))
    talk.lines(collision(answer), "bold red")


def _moments(acting: SupervisedRun, change_at: float) -> tuple[list[tuple[str, dict[str, Any]]], dict[str, Any]]:
    """The setting at the start and after the last action, and the belief before the change and at the end."""
    windows = acting.windows
    before = [w for w in windows if w.window.end_s <= change_at + 1e-6] or windows[:1]
    settings = [("as built", windows[0].setting.as_dict())]
    if acting.actions[0]:
        last = acting.actions[0][-1]
        settings.append((f"after the action at {last.time_s:g} s", last.setting.as_dict()))
    clouds = {}
    for name, w in (("belief before the change", before[-1]), ("belief at the end", windows[-1])):
        draws = w.window.belief.draws[:, 0]
        clouds[name] = (draws[:, 0], draws[:, 1])
    return settings, clouds
