"""Cars of one model partially pooled, whatever was estimated: SGLD over mean and spreads, then each car in closed form.

Each quantity is pooled by itself, in a coordinate in which cars vary normally: the logarithm of a lag, or that of the
prior of an effect's parameter.
"""

from __future__ import annotations

import math
import random
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from torch import Tensor

    from avtorch.inference.population import PopulationMargin

FEWEST = 3
"""Cars from which there are siblings to compare with."""

SAMPLED = 200
"""Cars that SGLD walks over at most, drawn at random from more: they tell the spread between cars to 5 %."""

Z_90 = 1.6448536269514722
"""Standard deviations from a normal's mean to its 5 and 95 % quantiles."""

Drive = Mapping[str, tuple[float, float]]
"""What a drive says: mean and standard deviation of the coordinate of each quantity."""


class Pooling:
    """The `quantities` of `cars`, each with one drive or more; all cars, numbered in order, are those of `names`.

    `spread`: what cars are expected to differ by, None: as much as lags do. `margin` is the density over all of them,
    `mean` (draw, quantity) the draws of the mean over cars.
    """

    def __init__(
        self,
        cars: Mapping[str, Sequence[Drive]],
        quantities: Sequence[str],
        seed: int = 0,
        *,
        spread: float | None = None,
    ) -> None:
        import torch

        from avtorch.inference import SamplerSettings, sample

        self.names = [name for name, drives in cars.items() if drives]
        self.drives = sum(len(cars[name]) for name in self.names)
        self.margin = _margin(cars, self.names, quantities, spread)
        many = len(self.names) > SAMPLED
        chosen = random.Random(seed).sample(self.names, SAMPLED) if many else self.names
        few = _margin(cars, chosen, quantities, spread) if many else self.margin
        # its draws are also what every car is drawn in by: fewer and longer chains than for one window
        settings = SamplerSettings(chains=64, draws=64, burn_in=16)
        self._posterior = sample(few, settings, generator=torch.Generator().manual_seed(seed))
        self._hyper, self._repeated = few.hyper, few.repeated
        self.sampled = few.cars
        self.mean: Tensor = self._posterior.flat[..., 0]

    def spreads(self, i: int) -> dict[str, Any]:
        """Of quantity `i`: how far cars differ, and how far drives of one car do (None where no car has two)."""
        draws = self._posterior.flat[:, i]
        # drives that were not repeated, by chance among those drawn, leave no spread between drives
        found = {"between": None, "within": None}
        found |= {key: interval(draws[:, k]) for k, key in enumerate(self._hyper) if k}
        converged = bool(self._posterior.converged[i])
        return {**found, "converged": converged, "why": "" if converged else self._posterior.why[i]}

    def next_car(self, i: int, seed: int = 0) -> Tensor:
        """Draws (draw,) of quantity `i` of a car of the model that was not driven."""
        import torch

        draws = self._posterior.flat[:, i]
        noise = torch.randn(len(draws), generator=torch.Generator().manual_seed(seed), dtype=draws.dtype)
        return draws[:, 0] + draws[:, 1] * noise

    def each_car(self) -> tuple[Tensor, Tensor]:
        """Mean and standard deviation (quantity, car) of every car, given its own drives and its siblings'."""
        import torch

        draws = self._posterior.flat[::16]
        z = torch.cat([draws[..., :1], draws[..., 1:].log()], -1)
        if self.margin.repeated and not self._repeated:
            z = torch.cat([z, torch.full_like(z[..., :1], -math.inf)], -1)
        first = second = inside = torch.zeros((), dtype=torch.float64)
        for one in z:  # each of all cars: memory for one draw at a time
            mean, variance = self.margin.cars_given(one)
            first, second, inside = first + mean, second + mean.square(), inside + variance
        first, second, inside = first / len(z), second / len(z), inside / len(z)
        return first, (inside + (second - first.square()).clamp_min(0.0)).sqrt()


def interval(draws: Tensor) -> dict[str, float]:
    """Median, 5 and 95 % quantile of draws (draw,)."""
    ordered = draws.sort().values
    at = (float(ordered[round(q * (len(ordered) - 1))]) for q in (0.5, 0.05, 0.95))
    return dict(zip(("median", "q05", "q95"), at, strict=True))


def _margin(
    cars: Mapping[str, Sequence[Drive]], names: Sequence[str], quantities: Sequence[str], spread: float | None
) -> PopulationMargin:
    import torch

    from avtorch.inference.population import SPREAD, PopulationMargin

    drives = [(number, drive) for number, name in enumerate(names) for drive in cars[name]]
    values, sd = (
        torch.tensor([[drive[q][part] for _, drive in drives] for q in quantities], dtype=torch.float64)
        for part in (0, 1)
    )
    number = torch.tensor([number for number, _ in drives])
    return PopulationMargin(values, sd, number, spread=SPREAD if spread is None else spread)
