"""Figures of the comparison: false alarms with intervals, delays, settings chosen for few alarms, operating curves."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import cast

import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor

from avtorch.errors import InputError
from avtorch.plots.style import BLACK, BLUE, GREEN, GREY, ORANGE, PURPLE, SKY, VERMILLION, styled
from benchmarks.blindtest.intervals import wilson
from benchmarks.detectors.drives import Beliefs
from benchmarks.detectors.judge import DETECTORS, first_alarm

Scores = Mapping[str, Tensor]
SOON_S = 30.0
DEFAULT = "stability or accepted_change"


@dataclass(frozen=True)
class Quiet:
    """False alarms on unchanged runs: how many of `runs` had one, and how many an hour up to the first one."""

    alarmed: int
    runs: int
    per_hour: float

    @property
    def interval(self) -> tuple[float, float]:
        between = wilson(self.alarmed, self.runs, 0.95)
        assert between is not None, "no runs"
        return between


@dataclass(frozen=True)
class Found:
    """On changed runs: `early` alarms before the change; of the others the share found within 30 s and at all, the
    median delay and the delay within which 90 % are found [s], infinite where fewer are."""

    early: int
    runs: int
    soon: int
    at_all: int
    median_s: float
    most_s: float


def times(score: Scores, beliefs: Beliefs, values: Mapping[str, float]) -> dict[str, Tensor]:
    """First alarm (run,) [s] of every detector at its value, and of the monitor's default pair at theirs."""
    at = {name: first_alarm(score[name], beliefs.end_s, DETECTORS[name].limit(value)) for name, value in values.items()}
    pair = [
        first_alarm(score[n], beliefs.end_s, DETECTORS[n].limit(DETECTORS[n].default))
        for n in ("stability", "accepted_change")
    ]
    return {**at, DEFAULT: torch.minimum(*pair)}


def quiet(first: Tensor, duration_s: float) -> Quiet:
    """Of first alarms (run,) [s] in runs where nothing changed."""
    alarmed = int(torch.isfinite(first).sum())
    hours = float(first.clamp_max(duration_s).sum()) / 3600.0
    return Quiet(alarmed, len(first), alarmed / hours)


def found(first: Tensor, change_s: Tensor) -> Found:
    """Of first alarms (run,) [s] in runs whose vehicle changed at `change_s` (run,) [s]."""
    early = first <= change_s + 1e-6
    delay = (first - change_s)[~early].sort().values
    n = len(delay)

    def quantile(share: float) -> float:
        return float(delay[max(0, math.ceil(share * n) - 1)]) if n else math.nan

    within, ever = int((delay <= SOON_S + 1e-6).sum()), int(torch.isfinite(delay).sum())
    return Found(int(early.sum()), len(first), within, ever, quantile(0.5), quantile(0.9))


def chosen(runs: Mapping[str, tuple[Beliefs, Scores]], most: float) -> dict[str, float]:
    """For each detector the most sensitive value that alarms in at most a share `most` of each kind of unchanged runs.

    A detector without such a value is left out.
    """
    out = {}
    for name, detector in DETECTORS.items():
        for value in detector.values:
            limit = detector.limit(value)
            shares = [quiet(first_alarm(s[name], b.end_s, limit), b.duration_s) for b, s in runs.values()]
            if all(q.alarmed <= most * q.runs for q in shares):
                out[name] = value
                break
    return out


def curve(
    name: str, unchanged: tuple[Beliefs, Scores], changed: tuple[Beliefs, Scores]
) -> list[tuple[float, float, float]]:
    """The operating curve of one detector: (value, share of unchanged runs alarmed, median delay [s]) by its values."""
    detector, out = DETECTORS[name], []
    for value in detector.values:
        limit = detector.limit(value)
        q = quiet(first_alarm(unchanged[1][name], unchanged[0].end_s, limit), unchanged[0].duration_s)
        f = found(first_alarm(changed[1][name], changed[0].end_s, limit), changed[0].change_s)
        out.append((value, q.alarmed / q.runs, f.median_s))
    return out


def rows(
    kept: Mapping[str, tuple[Beliefs, Scores]], values: Mapping[str, float], unchanged: list[str], changed: list[str]
) -> list[dict[str, object]]:
    """One row per detector, as plain numbers."""
    first = {kind: times(score, beliefs, values) for kind, (beliefs, score) in kept.items()}
    table = []
    for name in [*values, DEFAULT]:
        row: dict[str, object] = {"detector": name, "value": values.get(name)}
        for kind in unchanged:
            q = quiet(first[kind][name], kept[kind][0].duration_s)
            row[kind] = {"alarmed": q.alarmed, "runs": q.runs, "interval": q.interval, "per_hour": q.per_hour}
        for kind in changed:
            row[kind] = vars(found(first[kind][name], kept[kind][0].change_s))
        table.append(row)
    return table


def alarms(table: list[dict[str, object]], kinds: list[str]) -> str:
    """A markdown table of false alarms: share of unchanged runs with one (95 % Wilson), and how many an hour."""

    def cell(q: dict) -> str:
        low, high = (100.0 * x for x in q["interval"])
        rate = f", {q['per_hour']:.2g}/h" if q["alarmed"] else ""
        return f"{100.0 * q['alarmed'] / q['runs']:.3g} % ({low:.1f} to {high:.1f}){rate}"

    return _table(table, kinds, cell)


def delays(table: list[dict[str, object]], kinds: list[str]) -> str:
    """A markdown table of changes: median delay; found within 30 s, and by the end; runs with an alarm before."""

    def cell(f: dict) -> str:
        runs = f["runs"] - f["early"]
        if runs == 0:
            return "no run without an early alarm"
        seconds = f"{f['median_s']:.1f} s" if math.isfinite(f["median_s"]) else "-"
        early = f"; {f['early']} early" if f["early"] else ""
        return f"{seconds}; {100 * f['soon'] / runs:.0f} %, {100 * f['at_all'] / runs:.0f} %{early}"

    return _table(table, kinds, cell)


def _table(table: list[dict[str, object]], kinds: list[str], cell: Callable[[dict], str]) -> str:
    """One row per detector, one column per kind of run."""
    head = ["detector", "set to", *kinds]
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    for row in table:
        cells = [*_named(row), *(cell(cast(dict, row[kind])) for kind in kinds)]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _named(row: dict[str, object]) -> list[str]:
    name = str(row["detector"])
    return [name, "defaults" if row["value"] is None else f"{DETECTORS[name].tuned} {row['value']:.3g}"]


# Operating curves of detectors: delay against false alarms.
Point = tuple[float, float, float]
_COLOURS = (BLACK, BLUE, VERMILLION, ORANGE, PURPLE, SKY, GREEN, GREY)
_MARKS = "os^vDPX*"


def operating_curve(ax: Axes, curves: Mapping[str, Sequence[Point]]) -> Axes:
    """Plot the median delay [s] over the share of unchanged runs alarmed, one line per detector.

    ``curves`` by name hold ``(threshold, share alarmed, median delay [s])``. Down and left is better; points without a
    finite delay (fewer than half found) are left out.

    Raises:
        InputError: where there is no curve.
    """
    if not curves:
        raise InputError("curves: found none, needs one or more")
    for k, (name, points) in enumerate(curves.items()):
        finite = [(share, delay) for _, share, delay in points if math.isfinite(delay)]
        if not finite:
            continue
        x, y = zip(*finite, strict=True)
        ax.plot(
            x, y, color=_COLOURS[k % 8], marker=_MARKS[k % 8], markersize=4, linewidth=1, label=name.replace("_", " ")
        )
    ax.set_xscale("symlog", linthresh=0.01)
    ax.set_xticks([0, 0.01, 0.1, 1], ["0", "1 %", "10 %", "100 %"])
    ax.set_xlim(-0.002, 1.2)
    ax.set_ylim(bottom=0)
    ax.set(xlabel="unchanged runs with an alarm", ylabel="median delay [s]")
    return ax


@styled
def operating_figure(panels: Mapping[str, Mapping[str, Sequence[Point]]]) -> Figure:
    """One panel a set of curves, by name; one legend."""
    figure = Figure(figsize=(3.6 * len(panels) + 1.8, 3.6), layout="constrained")
    axes = figure.subplots(1, len(panels), squeeze=False, sharey=True)[0]
    for ax, (kind, curves) in zip(axes, panels.items(), strict=True):
        operating_curve(ax, curves).set_title(kind, fontsize=10)
    handles, labels = axes[0].get_legend_handles_labels()
    for ax in axes[1:]:
        for handle, label in zip(*ax.get_legend_handles_labels(), strict=True):
            if label not in labels:
                handles.append(handle)
                labels.append(label)
    figure.legend(handles, labels, loc="outside right upper")
    return figure
