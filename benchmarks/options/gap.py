"""The time gap: its cost in throughput, its benefit, the range of the driver's settings, and a driver who reacts
late.

At equilibrium a lane carries `3600 v / (tau v + standstill + length)` vehicles an hour (paper, Section 4.5, leaves the
price of a longer gap open). The belief gives the probability of string stability at each gap, and the peak gain.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor

from avtorch.decision import Grid, Setting, Strategist
from avtorch.decision.settings import DRIVER_TIME_GAPS
from avtorch.plots import save
from avtorch.plots.style import BLACK, BLUE, GREEN, GREY, ORANGE, VERMILLION, styled
from avtorch.vehicle import ClosedLoop, Leader, LowerLevel, performance, stability
from avtorch.vehicle.performance import equilibrium_throughput
from benchmarks.options.watched import CHANGE_S, WORN, belief, median_and_range, watched

MILD = (1.0, 0.8)
SPEED_MPS = 25.0
_COLOURS = (VERMILLION, BLUE, GREEN, ORANGE, BLACK)


@dataclass(frozen=True)
class GapTradeOff:
    """By time gap, every tensor (gap,): `throughput_vph` at 25 m/s, `p_string_stable`, and `peak_gain` as (5 %, median,
    95 %) [-], infinite where locally unstable.
    """

    time_gap: Tensor
    throughput_vph: Tensor
    p_string_stable: Tensor
    peak_gain: tuple[Tensor, Tensor, Tensor]

    def least_gap(self, required: float = 0.95) -> float | None:
        """The shortest of the gaps [s] that reaches P(string stable) `required`, None where none does."""
        enough = torch.nonzero(self.p_string_stable >= required)
        return float(self.time_gap[enough[:, 0]].min()) if len(enough) else None


@torch.no_grad()
def gap_trade_off(T_L: Tensor, K_L: Tensor, time_gaps: Tensor, setting: Setting) -> GapTradeOff:
    """Throughput, P(string stable) and peak gain over `time_gaps` (gap,) [s] under draws T_L [s], K_L [-] (draw,).

    `setting` (one scenario, its own time gap unused) gives lower level and gains.
    """
    T_e, K_e = setting.effective(T_L.double()[None], K_L.double()[None])
    seen = stability.stability_belief(T_e[0], K_e[0], time_gaps, setting.gains[0])
    peak = seen.margins["peak_gain"]
    flow = equilibrium_throughput(SPEED_MPS, time_gaps)
    return GapTradeOff(time_gaps, flow, seen.p_string_stable, (peak.q05, peak.q50, peak.q95))


def trade_off(out: Path | None) -> None:
    """Throughput against P(string stable) and peak gain."""
    T, K = belief()
    halved = Setting(T_hat=float(T.mean()), K_hat=float(K.mean()), T_d=float(T.mean()) / 2)
    curves = {
        f"worn {WORN}": ((T, K), Setting()),
        f"worn {WORN}, half its lag corrected": ((T, K), halved),
        f"mild {MILD}": (belief(MILD), Setting()),
    }
    print("| time gap [s] | vehicles/h at 25 m/s | " + " | ".join(f"{n}: P, peak gain" for n in curves) + " |")
    print("|---|---|" + "---|" * len(curves))
    gaps = torch.tensor([1.0, 1.2, 1.6, 2.0, 2.2, 2.5, 3.0], dtype=torch.float64)
    found = [gap_trade_off(*draws, gaps, setting) for draws, setting in curves.values()]
    for i, gap in enumerate(gaps.tolist()):
        cells = [f"{float(c.p_string_stable[i]):.2f}, {float(c.peak_gain[1][i]):.3f}" for c in found]
        print(f"| {gap:g} | {float(found[0].throughput_vph[i]):.0f} | " + " | ".join(cells) + " |")
    fine = torch.linspace(0.8, 3.2, 121, dtype=torch.float64)
    whole = {n: gap_trade_off(*draws, fine, setting) for n, (draws, setting) in curves.items()}
    for name, curve in whole.items():
        print(f"shortest time gap that reaches 0.95, {name}: {curve.least_gap() or math.nan:.2f} s")
    print(f"command effort of half the lag: {float(halved.amplification()[0]):.2f}")
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
        save(gap_figure(whole, marked=DRIVER_TIME_GAPS), out / "time-gap.png")


def gap_probability(ax: Axes, curves: Mapping[str, GapTradeOff], *, required: float = 0.95) -> Axes:
    """P(string stable) over the time gap, one line per curve, by name; the required level in grey."""
    for colour, (name, curve) in zip(_COLOURS, curves.items(), strict=False):
        ax.plot(curve.time_gap, curve.p_string_stable, color=colour, label=name)
    ax.axhline(required, color=GREY, linestyle=":", linewidth=1)
    ax.set(xlabel="time gap [s]", ylabel="P(string stable)", ylim=(-0.03, 1.03))
    return ax


def gap_peak(ax: Axes, curves: Mapping[str, GapTradeOff]) -> Axes:
    """Median peak gain over the time gap, with its 90 % interval."""
    for colour, (name, curve) in zip(_COLOURS, curves.items(), strict=False):
        low, middle, high = curve.peak_gain
        ax.plot(curve.time_gap, middle, color=colour, label=name)
        ax.fill_between(curve.time_gap, low, high, color=colour, alpha=0.2, linewidth=0)
    ax.axhline(1.0, color=GREY, linestyle=":", linewidth=1)
    ax.set(xlabel="time gap [s]", ylabel="peak gain [-]")
    return ax


def gap_throughput(ax: Axes, curve: GapTradeOff, *, marked: tuple[float, ...] = ()) -> Axes:
    """Equilibrium throughput over the time gap; the driver's settings are marked with their numbers."""
    ax.plot(curve.time_gap, curve.throughput_vph, color=BLACK)
    for gap in marked:
        i = int((curve.time_gap - gap).abs().argmin())
        flow = float(curve.throughput_vph[i])
        ax.plot(float(curve.time_gap[i]), flow, "o", color=BLUE)
        ax.annotate(f"{gap:g} s: {flow:.0f}", (gap, flow), xytext=(5, 5), textcoords="offset points", fontsize=8)
    ax.set(xlabel="time gap [s]", ylabel=f"vehicles an hour at {SPEED_MPS:g} m/s")
    return ax


@styled
def gap_figure(curves: Mapping[str, GapTradeOff], *, marked: tuple[float, ...] = ()) -> Figure:
    """Probability, peak gain and throughput over the time gap, side by side."""
    figure = Figure(figsize=(11.5, 3.6), layout="constrained")
    left, middle, right = figure.subplots(1, 3)
    gap_probability(left, curves).set_title("bought: string stability")
    gap_peak(middle, curves).set_title("bought: less amplification")
    middle.legend(loc="upper right")
    gap_throughput(right, next(iter(curves.values())), marked=marked).set_title("paid: throughput of a lane")
    return figure


def settings() -> None:
    """Which of the driver's settings the strategist selects, vehicle by vehicle, when it may change nothing else.

    Commands from -12 to 12 m/s², so that clipping does not decide.
    """

    def loop(leader: Leader) -> ClosedLoop:
        return ClosedLoop(leader, lower_level=LowerLevel(accel_min=-12.0, accel_max=12.0), seeds=0)

    print("| T_L [s], K_L | gap taken [s] | P(string stable) | exact peak gain at the truth |")
    print("|---|---|---|---|")
    for vehicle in ((0.3, 1.0), (0.8, 0.7), MILD, (1.2, 0.6), WORN, (2.0, 0.4)):
        rules = Strategist(Grid(allowed=frozenset({2})))
        run = watched(loop, vehicle=vehicle, duration=60.0, strategist=rules)
        if not run.actions[0]:
            print(f"| {vehicle[0]}, {vehicle[1]} | 1 (no action) | - | {_peak(vehicle, 1.0)} |")
            continue
        last = run.actions[0][-1]
        gap = float(last.setting.time_gap[0])
        note = "" if last.sufficient else ", not sufficient"
        print(f"| {vehicle[0]}, {vehicle[1]} | {gap:g} | {last.p_string_stable:.2f}{note} | {_peak(vehicle, gap)} |")


def driver(runs: int) -> None:
    """A driver asked for a longer gap, who complies later: what happens meanwhile."""
    print(
        "| driver complies after [s] | gap of 2.5 s reached [s after the change] | "
        "acceleration RMS over the leader's | least spacing [m] | collided |"
    )
    print("|---|---|---|---|---|")
    for delay in (None, 0.0, 5.0, 15.0, 30.0):
        rules = None if delay is None else Strategist(Grid(allowed=frozenset({2})), driver_delay=delay)
        run = watched(runs=runs, strategist=rules)
        late = run.rows[round(CHANGE_S * 100) :]
        measures = performance(late)
        reached = []
        for actions in run.actions:
            for a in actions[:1]:
                gap = float(a.setting.time_gap[0])
                reached.append(a.time_s + a.driver_delay_s + (gap - 1.0) / 0.1 - CHANGE_S)
        when = f"{sum(reached) / len(reached):.1f}" if reached else "-"
        name = "no request" if delay is None else f"{delay:g}"
        collided = f"{int(run.rows.collided.sum())} of {runs}"
        ratio, spacing = median_and_range(measures.accel_rms_ratio), median_and_range(measures.min_spacing_m)
        print(f"| {name} | {when} | {ratio} | {spacing} | {collided} |")


def _peak(vehicle: tuple[float, float], gap: float) -> str:
    truth = (torch.tensor([x], dtype=torch.float64) for x in vehicle)
    return f"{float(Setting(time_gap=gap).peak_gain(*truth)[0]):.3f}"
