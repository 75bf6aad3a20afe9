"""The size from which mini-batches pay, for a likelihood without sums: full batch, mini-batch, with control variates.

All arms sample one window row by row. The full batch takes averaged noise and avtorch's default step. A mini-batch
takes the longest step that keeps the SD ratio at 1.04 by the law of SGLD on a Gaussian,
``Var = (1 + h s2/4) / (1 - h/4)``, with the gradient's variance ``s2`` measured over mini-batches in the whitened
space. The effective draws of a step follow from the same law, less the loss from mini-batches that all chains share.
The seconds of a step are measured. A run to the wanted number of effective draws is made where affordable, and its SD
ratio is reported.
"""

from __future__ import annotations

import math
import sys
import time
from typing import Any

import torch
from torch import Tensor

from avtorch.inference import (
    JerkDensity,
    JerkPoints,
    JerkStatistics,
    Mode,
    SamplerSettings,
    find_mode,
    integrate,
    jerk_log_likelihood,
    sample,
)
from avtorch.inference.density import SubsampledDensity
from benchmarks.bias.control_variates import ControlVariates
from benchmarks.peers.problem import make_windows
from benchmarks.peers.score import WANTED

CHAINS = 16
BATCHES = (32, 256, 2048)
SD_RATIO = 1.04
#: Runs of at most so many seconds are made; longer ones are computed from the seconds of a step.
AFFORDABLE_S = 20.0


class PointwiseDensity:
    """The log density of `JerkPoints`, evaluated row by row also where the whole window is asked for."""

    names = ("T_L", "K_L", "sigma")

    def __init__(self, a: Tensor, u: Tensor, jerk: Tensor) -> None:
        self._rows = (a, u, jerk)
        self._points = JerkPoints(a, u, jerk)

    @property
    def windows(self) -> int:
        return self._points.windows

    @property
    def points(self) -> int:
        return self._points.points

    def constrain(self, z: Tensor) -> Tensor:
        return z.exp()

    def select(self, index: Tensor) -> PointwiseDensity:
        return PointwiseDensity(*(x[index] for x in self._rows))

    def log_prob(self, z: Tensor) -> Tensor:
        return self._points.prior.log_prob(z) + jerk_log_likelihood(*z.exp().unbind(-1), *self._rows)

    def log_prob_minibatch(self, z: Tensor, index: Tensor) -> Tensor:
        part = jerk_log_likelihood(*z.exp().unbind(-1), *(x[:, index] for x in self._rows))
        return self._points.prior.log_prob(z) + self.points / len(index) * part

    def initial(self) -> Tensor:
        return self._points.initial()


def minibatch(points: int, *, quick: bool = False) -> list[dict[str, Any]]:
    """Rows of one window of ``points`` rows: the full batch and the fastest batch of each kind of mini-batch."""
    window = make_windows(1, points=points, seed=6)
    rows = [torch.from_numpy(x) for x in (window.a, window.u, window.jerk)]
    density = PointwiseDensity(*rows)
    exact = integrate(JerkDensity(JerkStatistics.from_samples(*rows)))
    begun = time.perf_counter()
    mode = find_mode(density)
    mode_s = time.perf_counter() - begun
    default = SamplerSettings()
    step_s = seconds_a_step(density, mode, None)
    steps = WANTED / CHAINS * default.thinning
    found = [_row("full batch", points, None, default.step, 0.0, step_s, mode_s, steps)]
    begun = time.perf_counter()
    with_variates = ControlVariates(density, mode)
    variates_s = time.perf_counter() - begun
    for kind, target, before_s in (
        ("mini-batch", density, mode_s),
        ("mini-batch, control variates", with_variates, mode_s + variates_s),
    ):
        rows_of_kind = []
        for batch in [n for n in BATCHES if n < points]:
            s2 = gradient_variance(target, mode, batch)
            h = 4 * (SD_RATIO**2 - 1) / (s2 + SD_RATIO**2)
            shared = (h * s2 / 4) / (1 + h * s2 / 4)
            effective_chains = CHAINS / (1 + (CHAINS - 1) * shared)
            steps = WANTED / effective_chains * (4 - h) / h
            step_s = seconds_a_step(target, mode, batch)
            rows_of_kind.append(_row(kind, points, batch, h, s2, step_s, before_s, steps))
        if rows_of_kind:
            found.append(min(rows_of_kind, key=lambda row: row["seconds"]))
    for row in found:
        if not quick and row["seconds"] < AFFORDABLE_S:
            target = with_variates if "control" in row["kind"] else density
            row["sd_ratio"] = _run(target, mode, row, exact.sd)
        row["against_full"] = row["seconds"] / found[0]["seconds"]
        print(f"{points} points, {row['kind']}: {row['seconds']:.3g} s", file=sys.stderr, flush=True)
    return found


def _row(
    kind: str, points: int, batch: int | None, h: float, s2: float, step_s: float, before_s: float, steps: float
) -> dict[str, Any]:
    seconds = before_s + steps * step_s
    fields = {"kind": kind, "points": points, "batch": batch, "step": h, "gradient_variance": s2}
    return {**fields, "steps": math.ceil(steps), "step_s": step_s, "before_s": before_s, "seconds": seconds}


def seconds_a_step(density: SubsampledDensity, mode: Mode, batch: int | None) -> float:
    """Of all chains, with the sampler's own loop: what a longer run takes more, the least of three of each."""
    short, long = (4, 12) if density.points > 20_000 and batch is None else (10, 110)

    def least(steps: int) -> float:
        settings = _settings(batch, 1e-3, burn_in=0, draws=steps, thinning=1)
        times = []
        for _ in range(3):
            begun = time.perf_counter()
            sample(density, settings, mode=mode)
            times.append(time.perf_counter() - begun)
        return min(times)

    brief, whole = least(short), least(long)
    # at least half of the whole run's share: on a busy machine the difference may even be negative
    return max((whole - brief) / (long - short), 0.5 * whole / long)


def gradient_variance(density: SubsampledDensity, mode: Mode, batch: int, places: int = 16, batches: int = 64) -> float:
    """Largest variance over whitened directions of the mini-batch gradient, averaged over the Laplace posterior."""
    noise = torch.randn(places, *mode.z.shape, dtype=torch.float64)
    z = mode.z + torch.einsum("wij,cwj->cwi", mode.scale, noise)

    def gradient() -> Tensor:
        place = z.clone().requires_grad_()
        index = torch.randint(density.points, (batch,))
        (found,) = torch.autograd.grad(density.log_prob_minibatch(place, index).sum(), place)
        return torch.einsum("wji,cwj->cwi", mode.scale, found)[:, 0]

    drawn = torch.stack([gradient() for _ in range(batches)])  # (batch, place, 3)
    centred = drawn - drawn.mean(0)
    covariance = torch.einsum("bpi,bpj->ij", centred, centred) / (places * (batches - 1))
    return float(torch.linalg.eigvalsh(covariance)[-1])


def _settings(batch: int | None, h: float, *, burn_in: int, draws: int, thinning: int) -> SamplerSettings:
    noise = "averaged" if batch is None else "independent"
    counts = {"chains": CHAINS, "burn_in": burn_in, "draws": draws, "thinning": thinning}
    return SamplerSettings(step=h, batch=batch, noise=noise, attempts=1, **counts)


def _run(density: SubsampledDensity, mode: Mode, row: dict[str, Any], sd: Tensor) -> float:
    """The SD ratio furthest from 1 in a run of the row's steps."""
    thinning = max(1, row["steps"] // 400)
    burn_in = math.ceil(10 / row["step"])
    settings = _settings(row["batch"], row["step"], burn_in=burn_in, draws=row["steps"] // thinning, thinning=thinning)
    ratio = (sample(density, settings, mode=mode).sd / sd)[0]
    return float(ratio[(ratio - 1).abs().argmax()])
