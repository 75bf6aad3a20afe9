"""The posterior as the robust controller's design bounds, and the measures of a run with and without action."""

from __future__ import annotations

from itertools import product

import torch

from avtorch.decision import DesignBounds, Setting, Strategist
from avtorch.vehicle import performance
from benchmarks.options.watched import CHANGE_S, belief, median_and_range, watched

SETTINGS = (
    ("as designed", 1.0, (1.5, 1.5, -0.8)),
    ("time gap 1.6 s", 1.6, (1.5, 1.5, -0.8)),
    ("time gap 2.5 s", 2.5, (1.5, 1.5, -0.8)),
    ("paper's gains", 1.0, (3.0, 3.0, -1.8)),
)


def rechecked() -> None:
    """Eq. 2 and Eq. 3 over the handbook's box and over the posterior's, beside the exact verdict of the belief."""
    T, K = (x[None] for x in belief())
    after = DesignBounds.of_belief(T, K)
    handbook = DesignBounds(*(tuple(torch.tensor([x], dtype=torch.float64) for x in p) for p in ((0.1, 0.4), (0.7, 1))))
    new = ", ".join(f"{float(low[0]):.2f} to {float(high[0]):.2f}" for low, high in (after.T_L, after.K_L))
    print(f"posterior's box (95 %): T_L, K_L {new}")
    print("| setting | box | Eq. 2 | Eq. 3, print: B, B, C | passes: print, rigorous | exact P(string stable) |")
    print("|---|---|---|---|---|---|")
    for (name, gap, gains), (which, box) in product(SETTINGS, (("handbook", handbook), ("posterior", after))):
        local, string = box.recheck(gap, gains, form="print")
        _, rigorous = box.recheck(gap, gains)
        margins = ", ".join(f"{x:.2f}" for x in string.values[0].tolist())
        holds = [("yes" if bool(c.holds[0]) else "no") for c in (local, string, rigorous)]
        p = f"{float(Setting(time_gap=gap, gains=gains).p_string_stable(T, K)[0]):.2f}" if which == "posterior" else "-"
        print(f"| {name} | {which} | {holds[0]} | {margins} | {holds[1]}, {holds[2]} | {p} |")
    grid = [
        (gap, (1.5, k_v, k_a))
        for gap in (1.0, 1.6, 2.5)
        for k_v in (1.5, 2.0, 3.0, 4.0, 6.0)
        for k_a in (-0.8, -1.8, -3.0, -5.0, -8.0)
    ]
    for form in ("print", "rigorous"):
        good = [(g, k) for g, k in grid if all(bool(c.holds[0]) for c in after.recheck(g, k, form=form))]
        exact = sum(float(Setting(time_gap=g, gains=k).p_string_stable(T, K)[0]) >= 0.95 for g, k in grid)
        sure = sum(float(Setting(time_gap=g, gains=k).p_string_stable(T, K)[0]) >= 0.95 for g, k in good)
        print(f"{form}: {len(good)} of {len(grid)} designs pass over the posterior's box, first {good[:3]}; "
              f"{sure} of them have exact P >= 0.95, of all designs {exact}")  # fmt: skip


def measures(runs: int) -> None:
    """Comfort, energy, safe spacing and throughput after the change, without action and with the strategist."""
    done = {
        "no action": watched(runs=runs),
        "strategist": watched(runs=runs, strategist=Strategist()),
    }
    names = (
        "accel_rms_ratio", "jerk_rms_mps3", "comfort_share", "energy_jpkgm", "min_spacing_m", "min_ttc_s", "safe_share",
        "clipped_share", "throughput_vph",
    )  # fmt: skip
    print("| measure, from the change on | " + " | ".join(done) + " |")
    print("|---|" + "---|" * len(done))
    columns = []
    for run in done.values():
        gap = torch.tensor([a[-1].setting.time_gap[0] if a else 1.0 for a in run.actions], dtype=torch.float64)
        columns.append(performance(run.rows[round(CHANGE_S * 100) :], time_gap=gap))
    for name in names:
        print(f"| {name} | " + " | ".join(median_and_range(getattr(c, name)) for c in columns) + " |")
