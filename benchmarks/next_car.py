"""How often the 90 % interval of a car that was not driven holds it, of fleets whose cars differ by little or by much.

``python -m benchmarks.next_car [--fleets 200] [--seed 1]``

Each fleet has a cause whose one parameter, in the coordinate of its prior, varies normally between cars; one drive a
car tells it well (to 0.02). `avtorch.fleet.population` pools it as `avtorch fleet` does. Share of the next cars of
each fleet that the interval holds, in closed form, mean over fleets.
"""

from __future__ import annotations

import argparse

import torch
from torch.special import ndtr

from avtorch.fleet.population import effect_sizes
from avtorch.gap import EFFECTS

CARS, SPREADS = (3, 6, 20), (0.1, 0.3, 0.5, 1.0)
CAUSE, NAME, TOLD = "sensor_bias", "bias_mps2", 0.02


def held(cars: int, spread: float, seed: int) -> float:
    """The share of cars of the fleet's model that the interval holds."""
    (parameter,) = (p for p in EFFECTS[CAUSE].parameters if p.name == NAME)
    g = torch.Generator().manual_seed(seed)
    mean, *noise = torch.randn(1 + 2 * cars, generator=g, dtype=torch.float64).tolist()
    told = {str(i): [{CAUSE: {NAME: (mean + spread * noise[i] + TOLD * noise[cars + i], TOLD)}}] for i in range(cars)}
    found = effect_sizes(CAUSE, told)[0][NAME]["next_car"]
    ends = parameter.unconstrain(torch.tensor([found["q05"], found["q95"]], dtype=torch.float64))
    low, high = ndtr((ends - mean) / spread).tolist()
    return abs(high - low)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--fleets", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    torch.set_num_threads(1)
    print("cars  differ by [prior SD]  held [%]  standard error")
    for cars in CARS:
        for spread in SPREADS:
            shares = 100 * torch.tensor([held(cars, spread, given.seed + k) for k in range(given.fleets)])
            error = float(shares.std()) / given.fleets**0.5
            print(f"{cars:4}  {spread:20}  {float(shares.mean()):8.0f}  {error:14.1f}", flush=True)


if __name__ == "__main__":
    main()
