"""Importance sampling and SGLD on the same windows of the latent form, against a long reference: errors and cost.

    python -m benchmarks.latent_agreement [--windows 20] [--seed 1]

Windows are drawn from the law itself (speed alone, both channels, a clock that jitters; 2 s at 50 Hz) and only excited
ones are taken; with `AVTORCH_DATA` set, windows of 10 s of the Genesis laps as well. The reference has 20 times the
effective draws; SGLD is left out where the clock jitters, which takes it minutes a window. Cost in processor seconds,
which on a busy machine vary by a factor of two: compare them in one run.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Iterator
from pathlib import Path

import torch
from torch import Tensor

from avtorch.inference.importance import ImportanceSettings, WeightedDraws, weighted_draws
from avtorch.inference.latent import SAMPLER, LatentDensity, LatentWindow, latent_excitation
from avtorch.inference.sampler import sample
from avtorch.io import Log
from tests.inference.latent_windows import drawn_window

REFERENCE = ImportanceSettings(draws=4096, rounds=6, enough=8000.0)


def windows(count: int, seed: int) -> Iterator[LatentDensity]:
    generator = torch.Generator().manual_seed(seed)
    kinds = ({"accel": False}, {"accel": True}, {"accel": False, "jitter": 0.2})
    for kind in kinds:
        found = 0
        while found < count:
            density, _ = drawn_window(generator, speed=True, rows=100, dt=0.02, **kind)
            if bool(latent_excitation(density.data)[0]):
                found += 1
                yield density
    if folder := os.environ.get("AVTORCH_DATA"):
        for lap in (1, 2, 3):
            log = Log.read(Path(folder) / "genesis" / f"lap{lap}.csv")
            for first in range(0, log.rows - 999, 1000):
                rows = [
                    torch.from_numpy(x[first : first + 1000].copy()) for x in (log.elapsed, log.accel_cmd, log.speed)
                ]
                data = LatentWindow.single(rows[0], rows[1], speed=rows[2])
                if bool(latent_excitation(data)[0]):
                    yield LatentDensity(data)


def moments(draws: WeightedDraws) -> tuple[Tensor, Tensor]:
    """Mean and SD of T_L [s] and K_L [-]."""
    value, weight = draws.z.exp(), draws.weight[..., None]
    mean = (weight * value).sum(0)
    return mean[0, :2], (weight * (value - mean).square()).sum(0).sqrt()[0, :2]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--windows", type=int, default=20)
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    torch.set_num_threads(1)
    rows: dict[str, list[tuple[Tensor, Tensor, float]]] = {"importance": [], "sgld": []}
    for density in windows(given.windows, given.seed):
        generator = torch.Generator().manual_seed(given.seed)
        reference = weighted_draws(density, REFERENCE, generator=generator)
        mean, sd = moments(reference)
        begun = time.process_time()
        own = moments(weighted_draws(density, generator=generator))
        rows["importance"].append(((own[0] - mean) / sd, own[1] / sd, time.process_time() - begun))
        if density._steps is None:
            continue  # gradients row by row take minutes a window
        begun = time.process_time()
        chains = sample(density, SAMPLER, generator=generator).flat[:, 0, :2]
        spent = time.process_time() - begun
        rows["sgld"].append(((chains.mean(0) - mean) / sd, chains.std(0) / sd, spent))
    print(
        "| | windows | mean, median and 95 % [SD]: T_L | K_L | SD ratio, 5 to 95 %: T_L | K_L | processor s, median |"
    )
    print("|---|---|---|---|---|---|---|")
    for name, found in rows.items():
        off, ratio = (torch.stack([each[i] for each in found]) for i in (0, 1))
        cells = [f"{x.abs().median():.3f}, {x.abs().quantile(0.95):.3f}" for x in off.T]
        cells += [f"{x.quantile(0.05):.2f} to {x.quantile(0.95):.2f}" for x in ratio.T]
        spent = torch.tensor([each[2] for each in found]).median()
        print(f"| {name} | {len(found)} | {' | '.join(cells)} | {spent:.2f} |")


if __name__ == "__main__":
    main()
