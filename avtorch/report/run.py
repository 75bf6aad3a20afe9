"""The page of a run: what happened to the vehicle, what was seen of it, what was done, and what that changed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike

from avtorch.arrays import FloatArray
from avtorch.plots.plane import loop_of, region_figure
from avtorch.plots.time import TARGET, Motion, Steps, begun, motion_figure, overview_figure
from avtorch.report.estimates import window_table
from avtorch.report.page import Origin, Page, Picture, Section, picture_of
from avtorch.report.table import Table
from avtorch.results import MEASURES
from avtorch.vehicle import stability

_STRATEGIES = {1: "the lower level", 2: "the time gap", 3: "the gains", 4: "the leader's acceleration fed forward"}
_MOST = 40  # rows of the story
_DOTS, _POINTS = 150, 301  # draws of a cloud, points of a map's axis: more would make a page of megabytes


Regions = tuple[Sequence[tuple[str, Mapping[str, Any]]], Mapping[str, tuple[ArrayLike, ArrayLike]]]
"""Settings by name, and draws of T_L [s] and K_L, (draw,) each, by name, as `region_figure` takes them."""


def run_html(
    answer: Mapping[str, Any],
    time: ArrayLike,
    traces: Motion,
    *,
    truth: Mapping[str, Steps],
    bounds: Mapping[str, tuple[float, float]],
    regions: Regions,
    origin: Origin | None = None,
) -> str:
    """The page of a run as text; arguments as of `avtorch.plots.overview_figure`.

    `truth`: T_L [s] and K_L of the vehicle, the last of each from the change on.
    """
    overview = picture_of(
        "overview",
        overview_figure(answer, time, traces, truth=truth, bounds=bounds),
        window_table(answer["windows"]),
        caption="Blue: avtorch's belief, or the run with its actions. Dashed: the truth. Hatched: the bounds the "
        "controller was designed for.",
    )
    motion = picture_of("motion", motion_figure(answer, time, traces))
    story = story_table(answer)
    more = 1 + len(begun(answer)) + len(answer["actions"]) - len(story.rows)
    page = Page(
        "Run",
        f"simulated drive of {answer['windows'][-1]['end_s']:g} s",
        Section(_headline(answer), _lead(answer), (overview,), tables=(performance_table(answer),)),
        (
            Section("What happened", tables=(story,), items=(f"{more} more in run.json.",) if more else ()),
            Section("The motion", pictures=(motion,)),
            Section("Beliefs and stability regions", pictures=(_region(regions, truth),)),
            Section(
                "Method and limits",
                items=(
                    "The drive without action has the same leader, the same noise, and the setting it began with.",
                    "P(string stable) is that of the setting in force, for small motions, under the belief then.",
                    "The strategies are those of the paper's Algorithm 2, in its order: the lower level, the time gap, "
                    "the gains.",
                ),
            ),
        ),
        "green" if answer["windows"][-1]["p_string_stable"] >= TARGET else "amber",
    )
    return page.html(origin)


def _headline(answer: Mapping[str, Any]) -> str:
    change, actions = answer["change"]["time_s"], answer["actions"]
    after = [a for a in actions if a["time_s"] >= change]
    if after:
        return f"The change was answered {after[0]['time_s'] - change:.1f} s later, by {_means(after[0])}"
    seen = [a for a in answer["alerts"] if a["time_s"] >= change]
    if seen:
        return f"The change was seen {seen[0]['time_s'] - change:.1f} s later; nothing was done about it"
    return "No alert was raised after the change"


def _means(action: Mapping[str, Any]) -> str:
    """What an action changes, in words."""
    named = [_STRATEGIES[n] for n in action["strategies"]] or ["the setting it began with"]
    return " and ".join([", ".join(named[:-1]), named[-1]] if len(named) > 1 else named)


def _lead(answer: Mapping[str, Any]) -> tuple[str, ...]:
    change, both = answer["change"], answer["performance"]
    said = [
        f"At {change['time_s']:g} s the lag T_L becomes {change['T_L']:g} s and the gain K_L {change['K_L']:g}. "
        f"P(string stable) {_at_the_end(answer)}."
    ]
    with_, without = (both[side].get("speed_rms_ratio") for side in ("with_action", "without_action"))
    if answer["actions"] and with_ is not None and without is not None:
        said.append(
            f"The RMS of the follower's speed over that of its leader's is {with_:.2f} with action, {without:.2f} "
            "without; above 1 disturbances grow towards the traffic behind."
        )
    return (*said, *collision(answer))


def collision(answer: Mapping[str, Any]) -> list[str]:
    """That one of the two drives ends in a collision."""
    both = answer["performance"]
    hit = [side.replace("_", " ") for side, run in both.items() if (run.get("min_spacing_m") or 0.0) < 0]
    return [f"Collision {' and '.join(hit)}: everything after it, figures included, is not physical."] if hit else []


def _at_the_end(answer: Mapping[str, Any]) -> str:
    change, windows = answer["change"]["time_s"], answer["windows"]
    before = [w["p_string_stable"] for w in windows if w["end_s"] <= change + 1e-6]
    first = f"is {before[-1]:.2f} before the change, " if before else ""
    after = [w["p_string_stable"] for w in windows if w["end_s"] > change + 1e-6]
    least = f"falls to {min(after):.2f} and " if after and min(after) < after[-1] - 0.005 else ""
    return f"{first}{least}is {windows[-1]['p_string_stable']:.2f} at the end"


def performance_table(answer: Mapping[str, Any]) -> Table:
    """The measures of the drive without and with action."""
    both = answer["performance"]
    sides = ("without_action", "with_action") if answer["actions"] else ("with_action",)
    columns = ("measure", *(side.replace("_", " ") if answer["actions"] else "value" for side in sides))
    rows = tuple(
        (words, *(_number(both[side][key]) for side in sides))
        for key, words in MEASURES.items()
        if all(key in both[side] for side in sides)
    )
    caption = "The drive without and with action" if answer["actions"] else "The drive, without action"
    return Table(caption, columns, rows, numeric=columns[1:])


def _number(value: float | None) -> str:
    return "none" if value is None else f"{value:.3g}" if abs(value) < 1000 else f"{value:.0f}"


def story_table(answer: Mapping[str, Any]) -> Table:
    """The change, alerts and actions in order, the first of them."""
    change = answer["change"]
    lines = [(change["time_s"], "change", f"the vehicle changes to T_L {change['T_L']:g} s, K_L {change['K_L']:g}")]
    for a, more in begun(answer):
        again = f" (and in {more} more window{'s' * (more > 1)})" if more else ""
        lines.append((a["time_s"], "alert", f"{a['detector']}: {a['why']}{again}"))
    for a in answer["actions"]:
        gain = "" if a["peak_gain_true"] is None else f"; true peak gain {a['peak_gain_true']:.4f}"
        lines.append((a["time_s"], "action", f"{_means(a)}: {a['why']}{gain}"))
    # the sort is stable: an action stays behind the alert of the same time that it answers
    rows = tuple((f"{time:.1f}", kind, text) for time, kind, text in sorted(lines, key=lambda line: line[0])[:_MOST])
    return Table("Events in order", ("time [s]", "what", "why"), rows)


def _region(regions: Regions, truth: Mapping[str, Steps]) -> Picture:
    now = (float(truth["T_L"][-1][1]), float(truth["K_L"][-1][1]))
    settings, draws = regions
    clouds = {name: (np.asarray(T)[:_DOTS], np.asarray(K)[:_DOTS]) for name, (T, K) in draws.items()}
    return picture_of(
        "region",
        region_figure(settings, clouds, truth=now, points=_POINTS),
        _shares(regions, now),
        caption="A dot is a draw of the belief. String stable is what lies in the blue.",
    )


def _shares(regions: Regions, now: tuple[float, float]) -> Table:
    """Of each belief, T_L and K_L, and the share that is string stable under each setting."""
    settings, clouds = regions
    columns = ("vehicle", "T_L [s] (90 %)", "K_L (90 %)", *(f"string stable {name}" for name, _ in settings))
    rows = []
    for name, (T, K) in clouds.items():
        some = [np.asarray(values, dtype=float) for values in (T, K)]
        told = [f"{x.mean():.3f} ({np.quantile(x, 0.05):.2f} to {np.quantile(x, 0.95):.2f})" for x in some]
        rows.append((name, *told, *(f"{100 * _stable(setting, *some):.0f} %" for _, setting in settings)))
    one = [np.array([x]) for x in now]
    held = ("yes" if _stable(setting, *one) else "no" for _, setting in settings)
    rows.append(("truth", f"{now[0]:g}", f"{now[1]:g}", *held))
    return Table("The beliefs, and the share of each that is string stable", columns, tuple(rows))


def _stable(setting: Mapping[str, Any], T: FloatArray, K: FloatArray) -> float:
    verdict = stability.string_stable(*loop_of(setting, torch.from_numpy(T), torch.from_numpy(K)))
    return float(verdict.double().mean())
