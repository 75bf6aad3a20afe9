"""The time gap: its cost in throughput, its benefit, the range of the driver's settings, and a driver who reacts
late."""

from __future__ import annotations

import math
from pathlib import Path

import torch

from avtorch.decision import Grid, Setting, Strategist
from avtorch.decision.settings import DRIVER_TIME_GAPS
from avtorch.vehicle import ClosedLoop, Leader, LowerLevel, performance
from benchmarks.options.trade_off import gap_trade_off
from benchmarks.options.watched import CHANGE_S, WORN, belief, median_and_range, watched

MILD = (1.0, 0.8)


def trade_off(out: Path | None) -> None:
    """Throughput against P(string stable) and peak gain."""
    T, K = belief()
    halved = Setting(T_hat=float(T.mean()), K_hat=float(K.mean()), T_d=float(T.mean()) / 2)
    curves = {
        f"worn {WORN}": ((T, K), None),
        f"worn {WORN}, half its lag corrected": ((T, K), halved),
        f"mild {MILD}": (belief(MILD), None),
    }
    print("| time gap [s] | vehicles/h at 25 m/s | " + " | ".join(f"{n}: P, peak gain" for n in curves) + " |")
    print("|---|---|" + "---|" * len(curves))
    gaps = (1.0, 1.2, 1.6, 2.0, 2.2, 2.5, 3.0)
    found = [gap_trade_off(*draws, gaps, setting=setting) for draws, setting in curves.values()]
    for i, gap in enumerate(gaps):
        cells = [f"{float(c.p_string_stable[i]):.2f}, {float(c.peak_gain[1][i]):.3f}" for c in found]
        print(f"| {gap:g} | {float(found[0].throughput_vph[i]):.0f} | " + " | ".join(cells) + " |")
    fine = torch.linspace(0.8, 3.2, 121, dtype=torch.float64)
    whole = {n: gap_trade_off(*draws, fine, setting=setting) for n, (draws, setting) in curves.items()}
    for name, curve in whole.items():
        print(f"shortest time gap that reaches 0.95, {name}: {curve.least_gap() or math.nan:.2f} s")
    print(f"command effort of half the lag: {float(halved.amplification()[0]):.2f}")
    if out is not None:
        from avtorch.plots import save
        from benchmarks.options.gap_figure import gap_figure

        out.mkdir(parents=True, exist_ok=True)
        save(gap_figure(whole, marked=DRIVER_TIME_GAPS), out / "time-gap.png")


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
