"""SGLD compared with least squares, Kalman filters and the posterior mode on identical streams.

``python -m benchmarks.estimators [--only jerk|latent] [--seeds 100] [--latent-seeds 6] [--first-seed 0]
[--noise 0.1 0.3] [--accel-noise 0.1] [--window 2]``

Closed loops behind US06 (embedded), 80 s; at 26 s the vehicle changes from (0.3 s, 1) to (1.5 s, 0.5). No estimator
acts on the loop, so all get identical logs. `jerk`: jerk is measured. `latent`: acceleration only, with sensor noise.

Errors and coverage of the 90 % interval are over used windows (excited and converged): before the change, after it,
and late, from 50 s on; the error of a coverage is over seeds. Delay is from the change to the end of the first window
whose belief lies within the accepted change (0.2 s, 0.15) of the truth, whether it was used or carried over. Cost is
the processor time relative to SGLD's, each window given to all in turn, for all vehicles in one batch and for one
alone.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from avtorch.decision.algorithm2 import ACCEPTED_CHANGE
from avtorch.inference import BeliefStream, Form, JerkForm, Window
from avtorch.inference.latent import LatentForm
from avtorch.io.log import STANDSTILL_MPS
from avtorch.vehicle import Block, ClosedLoop, GLVDPlant, Leader

HEALTHY, DEGRADED = (0.3, 1.0), (1.5, 0.5)
CHANGE_S, LATE_S, END_S, DT = 26.0, 50.0, 80.0, 0.01
PHASES = ("before", "after", "late")


@dataclass
class Arm:
    """An estimator with its options, its belief after every window, and the processor seconds it took."""

    label: str
    stream: BeliefStream
    windows: list[Window] = field(default_factory=list)
    seconds: float = 0.0


def drive(seeds: int, *, first_seed: int = 0, noise: float = 0.1) -> Block:
    """Rows of `seeds` closed loops, `(seed, time)`."""
    plant = GLVDPlant(*HEALTHY, sigma=noise)
    loop = ClosedLoop(Leader.default(), plant=plant, scenarios=seeds, seeds=range(first_seed, first_seed + seeds))
    healthy = loop.advance(round(CHANGE_S / DT))
    loop.plant = GLVDPlant(*DEGRADED, sigma=noise)
    return Block.concatenate([healthy, loop.advance(round((END_S - CHANGE_S) / DT))])


def jerk_arms() -> dict[str, dict[str, object]]:
    """Default settings first, then other values of the one number that sets the rate of forgetting."""
    arms: dict[str, dict[str, object]] = {name: {"estimator": name} for name in ("sgld", "map", "rls", "ekf", "ukf")}
    for lam in (0.01, 1.0):
        arms[f"map, lambda {lam:g}"] = {"estimator": "map", "lam": lam}
    arms["map, mode forgetting"] = {"estimator": "map", "mode": "forgetting"}
    for factor in (0.99, 0.998, 0.9995):
        arms[f"rls, forgetting {factor:g}"] = {"estimator": "rls", "forgetting": factor}
    for drift in (0.001, 0.03, 0.1, 0.3):
        arms[f"ekf, drift {drift:g}"] = {"estimator": "ekf", "drift": drift}
    return arms


def latent_arms(noise: float, accel_noise: float) -> dict[str, dict[str, object]]:
    """Filters with the default noise levels, and with the simulator's own: noise held over a step, no unknown force."""
    levels = {"process_noise": noise * math.sqrt(DT), "accel_noise": accel_noise, "coloured_sd": 0.01}
    arms: dict[str, dict[str, object]] = {name: {"estimator": name} for name in ("sgld", "map", "ekf", "ukf")}
    return arms | {f"{name}, given the noise": {"estimator": name, "noise": levels} for name in ("ekf", "ukf")}


def run(
    arms: Mapping[str, dict[str, object]],
    form: Form,
    columns: Mapping[str, Tensor],
    time_s: Tensor,
    usable: Tensor,
    *,
    window: float,
    seed: int = 0,
) -> list[Arm]:
    """Every window's rows to every arm in turn."""
    vehicles, rows = usable.shape
    made = [
        Arm(label, BeliefStream(form=form, window=window, vehicles=vehicles, seed=seed, **options))  # pyright: ignore
        for label, options in arms.items()
    ]
    size = round(window / DT)
    for first in range(0, rows, size):
        part = slice(first, first + size)
        block = {name: column[:, part] for name, column in columns.items()}
        for arm in made:
            begun = time.process_time()
            until = float(time_s[part][-1]) + DT
            windows = arm.stream.feed(time_s[part], block, usable=usable[:, part], until=until)
            arm.seconds += time.process_time() - begun
            # the draws of all windows would not fit in memory
            arm.windows += [replace(w, belief=replace(w.belief, draws=w.belief.draws[:0])) for w in windows]
    return made


def phases(window: Window) -> list[str]:
    if window.end_s <= CHANGE_S + 1e-6:
        return ["before"]
    if window.start_s < CHANGE_S - 1e-6:
        return []  # a window with two vehicles has no single truth
    return ["after", "late"] if window.start_s >= LATE_S - 1e-6 else ["after"]


@dataclass(frozen=True)
class Score:
    """By phase `(T_L, K_L)`: median absolute errors, coverage and its standard error; delay of every seed [s]; share of
    excited windows that were used."""

    error: dict[str, Tensor]
    coverage: dict[str, Tensor]
    coverage_error: dict[str, Tensor]
    delay: Tensor
    used: float


def score(arm: Arm) -> Score:
    errors: dict[str, list[Tensor]] = {phase: [] for phase in PHASES}
    inside: dict[str, list[Tensor]] = {phase: [] for phase in PHASES}
    delay = torch.full((len(arm.windows[0].n),), torch.inf, dtype=torch.float64)
    excited = used_windows = 0
    for w in arm.windows:
        b = w.belief
        truth = torch.tensor(HEALTHY if "before" in phases(w) else DEGRADED, dtype=torch.float64)
        used = b.excited & b.converged
        error = (b.mean[:, :2] - truth).abs()
        covered = ((b.q05[:, :2] <= truth) & (truth <= b.q95[:, :2])).double()
        for phase in phases(w):
            # NaN keeps the seeds apart where a window was not used
            errors[phase].append(torch.where(used[:, None], error, torch.nan))
            inside[phase].append(torch.where(used[:, None], covered, torch.nan))
        if w.start_s >= CHANGE_S - 1e-6:
            there = (error <= torch.tensor(ACCEPTED_CHANGE, dtype=torch.float64)).all(-1)
            delay = torch.where(there & delay.isinf(), w.end_s - CHANGE_S, delay)
        excited, used_windows = excited + int(b.excited.sum()), used_windows + int(used.sum())
    windows = {phase: torch.stack(shares) for phase, shares in inside.items()}  # (window, seed, 2)
    return Score(
        {phase: torch.cat(each).nanmedian(0).values for phase, each in errors.items()},
        {phase: share.flatten(0, 1).nanmean(0) for phase, share in windows.items()},
        {phase: _error_over_seeds(share.nanmean(0)) for phase, share in windows.items()},
        delay,
        used_windows / max(excited, 1),
    )


def _error_over_seeds(by_seed: Tensor) -> Tensor:
    finite = by_seed[~by_seed.isnan().any(-1)]
    return finite.std(0) / math.sqrt(len(finite)) if len(finite) > 1 else torch.full((2,), torch.nan)


def pair(values: Tensor, form: str) -> str:
    return " / ".join(f"{x:{form}}" for x in values.tolist())


def table(arms: list[Arm], alone: list[Arm]) -> None:
    """A markdown table, one row an estimator; pairs are T_L [s] / K_L."""
    heads = [f"error {p}" for p in PHASES] + [f"90 % {p}" for p in PHASES]
    heads += ["delay [s], median", "95 %", "used", "cost, batch", "cost, one"]
    print("| estimator | " + " | ".join(heads) + " |")
    print("|---|" + "---:|" * len(heads))
    worst = torch.zeros(2, dtype=torch.float64)
    for arm, one in zip(arms, alone, strict=True):
        s = score(arm)
        cells = [pair(s.error[p], ".3f") for p in PHASES] + [pair(100 * s.coverage[p], ".0f") for p in PHASES]
        cells += [f"{x:.0f}" if x < math.inf else "never" for x in _quantiles(s.delay)]
        cells += [f"{100 * s.used:.0f} %", f"{arm.seconds / arms[0].seconds:.3g}"]
        cells += [f"{one.seconds / alone[0].seconds:.3g}"]
        worst = torch.fmax(worst, torch.stack(list(s.coverage_error.values())).amax(0))
        print(f"| {arm.label} | " + " | ".join(cells) + " |", flush=True)
    print(f"\nLargest standard error of a coverage in the table, over seeds: {100 * float(worst.max()):.1f} %\n")


def _quantiles(delay: Tensor) -> list[float]:
    ordered = delay.sort().values
    return [float(ordered[min(int(q * len(ordered)), len(ordered) - 1)]) for q in (0.5, 0.95)]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", choices=("jerk", "latent"))
    parser.add_argument("--seeds", type=int, default=100)
    parser.add_argument("--latent-seeds", type=int, default=6)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--noise", type=float, nargs="+", default=[0.1, 0.3], help="jerk noise [m/s³]")
    parser.add_argument("--accel-noise", type=float, default=0.1, help="sensor noise of the latent form [m/s²]")
    parser.add_argument("--window", type=float, default=2.0, help="length of a window [s]; 26 s must hold whole ones")
    options = parser.parse_args()
    torch.set_num_threads(1)
    for noise in options.noise if options.only != "latent" else []:
        block = drive(options.seeds, first_seed=options.first_seed, noise=noise)
        columns = {name: getattr(block, name) for name in JerkForm.columns}
        print(f"Jerk measured, noise {noise:g} m/s³, {options.seeds} seeds from {options.first_seed}\n", flush=True)
        compare(jerk_arms(), JerkForm(), columns, block, options)
    for noise in options.noise[:1] if options.only != "jerk" else []:
        block = drive(options.latent_seeds, first_seed=options.first_seed, noise=noise)
        g = torch.Generator().manual_seed(options.first_seed)
        blur = options.accel_noise * torch.randn(block.accel.shape, generator=g, dtype=torch.float64)
        columns = {"accel_cmd": block.accel_cmd, "accel": block.accel + blur}
        print(
            f"Acceleration only, sensor noise {options.accel_noise:g} m/s², jerk noise {noise:g} m/s³, "
            f"{options.latent_seeds} seeds from {options.first_seed}\n",
            flush=True,
        )
        arms = latent_arms(noise, options.accel_noise)
        compare(arms, LatentForm(accel=True, speed=False), columns, block, options)


def compare(
    arms: Mapping[str, dict[str, object]],
    form: Form,
    columns: Mapping[str, Tensor],
    block: Block,
    options: argparse.Namespace,
) -> None:
    """One table; the cost for one vehicle is that of the first seed."""
    crashed = (block.spacing <= 0).int().cummax(-1).values.bool()
    usable = (block.speed >= STANDSTILL_MPS) & ~crashed
    one = {name: column[:1] for name, column in columns.items()}
    keywords = {"window": options.window, "seed": options.first_seed}
    alone = run(arms, form, one, block.time, usable[:1], **keywords)
    batch = run(arms, form, columns, block.time, usable, **keywords)
    table(batch, alone)
    if bool(crashed.any()):
        print(f"{int(crashed[:, -1].sum())} seeds collided; their rows end there.\n")


if __name__ == "__main__":
    main()
