"""How often 90 % intervals of T_L and K_L hold the truth, on windows of the latent form drawn from their own law.

    python -m benchmarks.latent_coverage [--kind speed] [--windows 1200] [--seed 1]

Parameters from the prior, 2 s at 50 Hz, a command that steps at random times: speed alone, speed and acceleration, both
with stamps that jitter by up to 0.3 of a step; and, against the law, both through a recorder that rounds (0.02 m/s,
0.05 m/s²) and holds every fifth value. Each window alone, under the first prior. Windows that would go on to SGLD are
left out and not counted as used, because it takes minutes where stamps jitter; *hard* are the used ones whose first
draws were not reliable.
"""

from __future__ import annotations

import argparse
import math
import time
from dataclasses import replace

import torch
from torch import Tensor

from avtorch.inference.density import Density
from avtorch.inference.estimators import ImportanceSampling
from avtorch.inference.estimators.other_posteriors import FIRST
from avtorch.inference.importance import weighted_draws
from avtorch.inference.latent import LatentDensity, default_noise_prior
from avtorch.inference.map import Mode
from avtorch.inference.sequential import Solved
from tests.inference.latent_windows import drawn_window

KINDS = {
    "speed": {"accel": False},
    "both": {"accel": True},
    "jitter": {"accel": True, "jitter": 0.3},
    "recorder": {"accel": True},
}
HELD = 5
QUANTA = {"speed": 0.02, "accel": 0.05}


class Drawn(ImportanceSampling):
    """Weighted draws alone, without SGLD behind them."""

    def _chains(self, density: Density, mode: Mode) -> Solved:
        return self._drawn(density, mode, FIRST)._replace(converged=torch.zeros(density.windows, dtype=torch.bool))


def recorded(density: LatentDensity) -> LatentDensity:
    """The same window behind a recorder that rounds and holds."""
    at = torch.arange(density.data.time.shape[1]) // HELD * HELD
    rounded = {name: (getattr(density.data, name)[:, at] / step).round() * step for name, step in QUANTA.items()}
    return LatentDensity(replace(density.data, **rounded))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kind", choices=KINDS, nargs="*", default=list(KINDS))
    parser.add_argument("--windows", type=int, default=1200)
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    torch.set_num_threads(1)
    print("| windows | used | T_L | K_L | standard error | hard | T_L | K_L | processor s a window |")
    print("|---|---:|---:|---:|---:|---:|---:|---:|---:|")
    for kind in given.kind:
        generator = torch.Generator().manual_seed(given.seed)
        held: list[Tensor] = []
        hard: list[bool] = []
        spent = 0.0
        for i in range(given.windows):
            density, truth = drawn_window(generator, speed=True, rows=100, dt=0.02, **KINDS[kind])
            density = recorded(density) if kind == "recorder" else density
            first = weighted_draws(density, generator=torch.Generator().manual_seed(given.seed + i))
            noise = default_noise_prior(density.names[2:])
            loop = Drawn(names=density.names, noise_prior=noise, seed=given.seed + i)
            begun = time.process_time()
            belief = loop.update(lambda index, prior, d=density: d, torch.tensor([True]))
            spent += time.process_time() - begun
            if bool(belief.converged[0]):
                held.append((belief.q05[0, :2] <= truth[:2]) & (truth[:2] <= belief.q95[0, :2]))
                hard.append(not bool(first.converged(FIRST)))
        inside, chosen = torch.stack(held).double(), torch.tensor(hard)
        every, these = (100 * x.mean(0) for x in (inside, inside[chosen]))
        error = 100 * math.sqrt(0.09 / len(inside))
        print(
            f"| {kind} | {len(inside)} of {given.windows} | {every[0]:.1f} | {every[1]:.1f} | {error:.1f} | "
            f"{int(chosen.sum())} | {these[0]:.1f} | {these[1]:.1f} | {spent / given.windows:.2f} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
