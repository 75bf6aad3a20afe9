"""How well the paper's change is detected and handled: many seeds of the closed loop in one batch.

``python -m benchmarks.monitoring [--seeds 200] [--noise 0.1] [--strategy none|auto] [--leader FILE --start S]``

Prints one row: seeds with an alert before the change, and by one window after it; share of moving windows that are
excited; coverage of the 90 % interval over excited windows; median absolute errors before and after; with an action,
how many of the chosen settings are sufficient and how many have an exact peak gain of at most 1.001 at the truth.
"""

from __future__ import annotations

import argparse
from collections import Counter
from pathlib import Path

import torch
from torch import Tensor

from avtorch.decision.grid import Grid
from avtorch.decision.strategist import Strategist
from avtorch.decision.supervisor import ALLOWED, Supervisor
from avtorch.decision.watch import SupervisedRun
from avtorch.vehicle import ClosedLoop, GLVDPlant, Leader

HEALTHY = (0.3, 1.0)


def drive(
    leader: Leader,
    *,
    seeds: int,
    first_seed: int = 0,
    noise: float = 0.1,
    change_at: float = 26.0,
    vehicle: tuple[float, float] = (1.5, 0.5),
    duration: float = 80.0,
    strategy: str = "none",
) -> SupervisedRun:
    """`seeds` closed loops in one batch, each with its own jerk noise; the vehicle changes at `change_at` [s]."""
    plant = GLVDPlant(*HEALTHY, sigma=noise)
    loop = ClosedLoop(leader, plant=plant, scenarios=seeds, seeds=range(first_seed, first_seed + seeds))
    strategist = None if strategy == "none" else Strategist(Grid(allowed=ALLOWED[strategy]))

    def change(world: ClosedLoop) -> None:
        world.plant = GLVDPlant(*vehicle, sigma=noise)

    return Supervisor(loop, strategist=strategist, seed=first_seed).run(duration, events=[(change_at, change)])


def score(
    run: SupervisedRun, *, change_at: float = 26.0, vehicle: tuple[float, float] = (1.5, 0.5), window: float = 2.0
) -> dict[str, object]:
    """The figures of one batch, by name."""
    early = [any(a.time_s <= change_at + 1e-6 for a in alerts) for alerts in run.alerts]
    first = [min((a.time_s for a in alerts if a.time_s > change_at + 1e-6), default=torch.inf) for alerts in run.alerts]
    excited, moving, inside = [], [], []
    errors: dict[bool, list[Tensor]] = {False: [], True: []}
    reached: list[Tensor] = []  # seeds that have had an excited window since the change
    for watched in run.windows:
        w, belief = watched.window, watched.window.belief
        after = w.start_s >= change_at - 1e-6
        if not after and w.end_s > change_at + 1e-6:
            continue  # a window with two vehicles has no single truth
        truth = torch.tensor(vehicle if after else HEALTHY, dtype=torch.float64)
        used = belief.excited & belief.converged
        covered = (belief.q05[:, :2] <= truth) & (truth <= belief.q95[:, :2])
        inside.append(covered[used])
        excited.append(belief.excited)
        moving.append(w.n >= 100)
        errors[after].append((belief.mean[:, :2] - truth).abs()[used])
        if after:
            reached.append(belief.excited)
    informed = torch.stack(reached).int().argmax(0) if reached else torch.zeros(len(first))
    due = [change_at + window * (1 + int(k)) for k in informed]
    informative, moved = torch.stack(excited), torch.stack(moving)
    coverage = torch.cat(inside).double().mean(0)
    pooled = {after: torch.cat(e) for after, e in errors.items() if e}
    median = {after: e.median(0).values for after, e in pooled.items() if len(e)}
    actions = [a for scenario in run.actions for a in scenario]
    last = [scenario[-1] for scenario in run.actions if scenario]
    return {
        "seeds": len(first),
        "alert_before": sum(early) / len(early),
        "alert_by_one_window": sum(t <= change_at + window + 1e-6 for t in first) / len(first),
        "alert_by_first_excited_window": sum(t <= d + 1e-6 for t, d in zip(first, due, strict=True)) / len(first),
        "excited_of_moving": float((informative & moved).sum() / moved.sum().clamp_min(1)),
        "coverage_T_L": float(coverage[0]),
        "coverage_K_L": float(coverage[1]),
        "error_before": [float(x) for x in median.get(False, torch.full((2,), torch.nan))],
        "error_after": [float(x) for x in median.get(True, torch.full((2,), torch.nan))],
        "actions": len(actions),
        "sufficient": sum(a.sufficient for a in actions),
        "p_at_least_095": sum(a.p_string_stable >= 0.95 for a in actions),
        "last_gain_at_most_1.001": sum((a.peak_gain_true or torch.inf) <= 1.001 for a in last) / max(len(last), 1),
        "any_gain_at_most_1.001": sum((a.peak_gain_true or torch.inf) <= 1.001 for a in actions) / max(len(actions), 1),
        "strategies": dict(Counter("+".join(map(str, a.strategies)) or "default" for a in last)),
        "collided": int(run.rows.collided.sum()),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=200)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--noise", type=float, default=0.1)
    parser.add_argument("--strategy", choices=("none", *ALLOWED), default="none")
    parser.add_argument("--leader", type=Path)
    parser.add_argument("--vehicle", type=int)
    parser.add_argument("--start", type=float, default=0.0)
    parser.add_argument("--T", type=float, default=1.5)
    parser.add_argument("--K", type=float, default=0.5)
    options = parser.parse_args()
    if options.leader is None:
        leader = Leader.default(start=options.start)
    else:
        leader = Leader.read(options.leader, vehicle=options.vehicle, start=options.start)
    changed = (options.T, options.K)
    run = drive(
        leader,
        seeds=options.seeds,
        first_seed=options.first_seed,
        noise=options.noise,
        strategy=options.strategy,
        vehicle=changed,
    )
    print(f"{leader.name}, start {options.start:g} s, noise {options.noise:g} m/s^3, strategy {options.strategy}")
    for name, value in score(run, vehicle=changed).items():
        text = f"{value:.4f}" if isinstance(value, float) else value
        print(f"  {name:32} {text}")


if __name__ == "__main__":
    main()
