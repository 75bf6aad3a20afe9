"""The page of a run: what happened to the vehicle, what was seen of it, what was done, and what that changed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from avtorch.plots.figures import Motion, motion_figure, overview_figure, region_figure
from avtorch.plots.time import Steps
from avtorch.report.answer_page import AnswerPage, Section, Tone, answer_html, written
from avtorch.report.origin import Origin
from avtorch.report.picture import Picture, picture_of
from avtorch.report.table import Table
from avtorch.report.window_table import window_table

_MEASURES = {
    "speed_rms_ratio": "speed RMS, follower / leader [-]",
    "accel_rms_ratio": "acceleration RMS, follower / leader [-]",
    "min_spacing_m": "least spacing [m]",
    "min_ttc_s": "least time to collision [s]",
    "jerk_rms_mps3": "jerk RMS [m/s³]",
    "clipped_share": "share of commands clipped [-]",
    "throughput_vph": "throughput at equilibrium [1/h]",
}
_MOST = 40  # rows of the story
_DOTS, _POINTS = 150, 201  # draws of a cloud, points of a map's axis: more would make a page of megabytes


@dataclass(frozen=True)
class Regions:
    """Beliefs in the stability regions of settings, as `region_figure` draws them.

    `settings`: (name, setting) pairs; `clouds`: draws of T_L [s] and K_L, (draw,) each, by name.
    """

    settings: Sequence[tuple[str, Mapping[str, Any]]]
    clouds: Mapping[str, tuple[ArrayLike, ArrayLike]]


def run_html(
    answer: Mapping[str, Any],
    time: ArrayLike,
    traces: Motion,
    *,
    truth: Mapping[str, Steps] | None = None,
    bounds: Mapping[str, tuple[float, float]] | None = None,
    regions: Regions | None = None,
    origin: Origin | None = None,
) -> str:
    """The page of a run as text; arguments as of `avtorch.plots.overview_figure`, whose `truth` says what T_L [s] and
    K_L are from the change on.

    Example:
        >>> from avtorch import Leader, estimate, simulate
        >>> from avtorch.report import run_html
        >>> from avtorch.results import estimates_answer
        >>> log = simulate(Leader.default(start=50.0, duration=4.0, dt=0.02)).log()
        >>> change = {"time_s": 2.0, "T_L": 0.3, "K_L": 1.0}
        >>> answer = {**estimates_answer(estimate(log, estimator="map")), "alerts": [], "actions": []}
        >>> answer |= {"change": change, "performance": {"without_action": {}, "with_action": {}}}
        >>> page = run_html(answer, log.elapsed, {"accel": {"leader": log.lead_accel, "with action": log.accel}})
        >>> "No alert was raised" in page
        True
    """
    change = answer["change"]
    overview = picture_of(
        "overview",
        lambda narrow: overview_figure(answer, time, traces, truth=truth, bounds=bounds, narrow=narrow),
        f"Four lines over time: acceleration, the belief about lag and about gain, and P(string stable), which "
        f"{_at_the_end(answer)}.",
        caption="Blue: avtorch's belief, or the run with its actions. Dashed: the truth. Hatched: the bounds the "
        "controller was designed for.",
    )
    motion = picture_of(
        "motion",
        lambda narrow: motion_figure(answer, time, traces, narrow=narrow),
        f"Lines of {', '.join(traces)} over time: {', '.join(dict.fromkeys(n for q in traces.values() for n in q))}.",
    )
    story = _story(answer)
    page = AnswerPage(
        "Run",
        f"T_L {change['T_L']:g} s and K_L {change['K_L']:g} from {change['time_s']:g} s on",
        Section(_headline(answer), _lead(answer), (overview,), (_performance(answer),)),
        (
            Section("What happened", tables=(story,), items=_hidden(answer, story)),
            Section("The motion", pictures=(motion,)),
            Section("Beliefs and stability regions", pictures=() if regions is None else (_regions(regions, truth),)),
            Section("Windows", folded=(window_table(answer["windows"]),)),
            Section(
                "Method and limits",
                items=(
                    "The drive without action has the same leader, the same noise, and the setting it began with.",
                    "P(string stable) is that of the setting in force, for small motions, under the belief then.",
                    "Strategies: 1 the lower level, 2 the time gap as well, 3 the gains as well (Algorithm 2).",
                ),
            ),
        ),
        _tone(answer),
    )
    return answer_html(page, origin=origin)


def write_run_page(answer: Mapping[str, Any], *args: Any, folder: str | PathLike[str], **more: Any) -> Path:
    """Write `run.html` into `folder`; returns its path. Raises `InputError` where it cannot be written.

    The other arguments are those of `run_html`.

    Example:
        >>> from avtorch import Leader, estimate, simulate
        >>> from avtorch.report import write_run_page
        >>> from avtorch.results import estimates_answer
        >>> log = simulate(Leader.default(start=50.0, duration=4.0, dt=0.02)).log()
        >>> change = {"time_s": 2.0, "T_L": 0.3, "K_L": 1.0}
        >>> answer = {**estimates_answer(estimate(log, estimator="map")), "alerts": [], "actions": []}
        >>> answer |= {"change": change, "performance": {"without_action": {}, "with_action": {}}}
        >>> write_run_page(answer, log.elapsed, {"accel": {"leader": log.lead_accel}}, folder="out").name
        'run.html'
    """
    return written(run_html(answer, *args, **more), folder, "run.html")


def _headline(answer: Mapping[str, Any]) -> str:
    change, actions = answer["change"]["time_s"], answer["actions"]
    after = [a for a in actions if a["time_s"] >= change]
    if after:
        return f"The change was answered {after[0]['time_s'] - change:.1f} s later, by {_strategies(after[0])}"
    seen = [a for a in answer["alerts"] if a["time_s"] >= change]
    if seen:
        return f"The change was seen {seen[0]['time_s'] - change:.1f} s later; nothing was done about it"
    return "No alert was raised after the change"


def _strategies(action: Mapping[str, Any]) -> str:
    names = " and ".join(map(str, action["strategies"]))
    if not names:
        return "no strategy"
    return f"{'strategies' if len(action['strategies']) > 1 else 'strategy'} {names}"


def _lead(answer: Mapping[str, Any]) -> tuple[str, ...]:
    change = answer["change"]
    said = [
        f"At {change['time_s']:g} s the lag T_L becomes {change['T_L']:g} s and the gain K_L {change['K_L']:g}.",
        f"P(string stable) {_at_the_end(answer)}.",
    ]
    hit = [s.replace("_", " ") for s, run in answer["performance"].items() if (run.get("min_spacing_m") or 0.0) < 0]
    if hit:
        said.append(f"Collision {' and '.join(hit)}: everything after it, figures included, is not physical.")
    return tuple(said)


def _at_the_end(answer: Mapping[str, Any]) -> str:
    change, windows = answer["change"]["time_s"], answer["windows"]
    before = [w["p_string_stable"] for w in windows if w["end_s"] <= change + 1e-6]
    first = f"is {before[-1]:.2f} before the change, " if before else ""
    after = [w["p_string_stable"] for w in windows if w["end_s"] > change + 1e-6]
    least = f"falls to {min(after):.2f} and " if after and min(after) < after[-1] - 0.005 else ""
    return f"{first}{least}is {windows[-1]['p_string_stable']:.2f} at the end"


def _tone(answer: Mapping[str, Any]) -> Tone:
    return "green" if answer["windows"][-1]["p_string_stable"] >= 0.95 else "amber"


def _performance(answer: Mapping[str, Any]) -> Table:
    both = answer["performance"]
    columns = ("measure", "without action", "with action")
    rows = tuple(
        (words, *(_number(both[side][key]) for side in ("without_action", "with_action")))
        for key, words in _MEASURES.items()
        if all(key in both[side] for side in ("without_action", "with_action"))
    )
    return Table("The drive without and with action", columns, rows, numeric=columns[1:])


def _number(value: float | None) -> str:
    return "none" if value is None else f"{value:.3g}" if abs(value) < 1000 else f"{value:.0f}"


def _story(answer: Mapping[str, Any]) -> Table:
    change = answer["change"]
    lines = [
        (change["time_s"], "change", f"the vehicle changes to T_L {change['T_L']:g} s, K_L {change['K_L']:g}"),
        *((a["time_s"], "alert", f"{a['detector']}: {a['why']}") for a in answer["alerts"]),
    ]
    for a in answer["actions"]:
        gain = "" if a["peak_gain_true"] is None else f"; true peak gain {a['peak_gain_true']:.4f}"
        lines.append((a["time_s"], "action", f"{_strategies(a)}: {a['why']}{gain}"))
    # the sort is stable: an action stays behind the alert of the same time that it answers
    rows = tuple((f"{time:.1f}", kind, text) for time, kind, text in sorted(lines, key=lambda line: line[0])[:_MOST])
    marked = {i for i, row in enumerate(rows) if row[1] == "action"}
    return Table("Events in order", ("time [s]", "what", "why"), rows, marked=marked)


def _hidden(answer: Mapping[str, Any], story: Table) -> tuple[str, ...]:
    more = 1 + len(answer["alerts"]) + len(answer["actions"]) - len(story.rows)
    return (f"{more} more in run.json.",) if more else ()


def _regions(regions: Regions, truth: Mapping[str, Steps] | None) -> Picture:
    now = None if truth is None else (float(truth["T_L"][-1][1]), float(truth["K_L"][-1][1]))
    names = ", ".join(name for name, _ in regions.settings)
    clouds = {name: (np.asarray(T)[:_DOTS], np.asarray(K)[:_DOTS]) for name, (T, K) in regions.clouds.items()}
    return picture_of(
        "region",
        lambda narrow: region_figure(regions.settings, clouds, truth=now, narrow=narrow, points=_POINTS),
        f"Maps over lag and gain of where the loop is locally and string stable, one for each setting ({names}), with "
        f"{' and '.join(regions.clouds)}.",
        caption="A dot is a draw of the belief. String stable is what lies in the blue.",
    )
