"""The cars of a fleet beside one another: partially pooled T_L and K_L, and how large a cause is.

SGLD walks over mean and spreads, then each car follows in closed form. Each quantity is pooled by itself, in a
coordinate in which cars vary normally: the logarithm of a lag or gain, or that of the prior of an effect's parameter,
in which typical sizes have a standard deviation of one. Parameters that belong to the drive (a road, the row at which a
gain changes) are no car's and are left out.
"""

from __future__ import annotations

import math
import random
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from scipy.stats import false_discovery_control
from torch import Tensor

from avtorch.fleet.folder import LEAST_SD, QUANTITIES, Drive
from avtorch.gap import EFFECTS
from avtorch.gap.simulator.parameter import Parameter
from avtorch.inference import SamplerSettings, sample
from avtorch.inference.population import MEAN_SD, SPREAD, PopulationMargin

FEWEST = 3
"""Cars from which there are siblings to compare with."""

SAMPLED = 200
"""Cars that SGLD walks over at most, drawn at random from more: they tell the spread between cars to 5 %."""

Z_90 = 1.6448536269514722
"""Standard deviations from a normal's mean to its 5 and 95 % quantiles."""


class Pooling:
    """The `quantities` of `cars`, each with one drive or more; all cars, numbered in order, are those of `names`.

    `spread`: what cars are expected to differ by. `margin` is the density over all of them, `mean` (draw, quantity) the
    draws of the mean over cars.
    """

    def __init__(
        self,
        cars: Mapping[str, Sequence[Drive]],
        quantities: Sequence[str],
        seed: int = 0,
        *,
        spread: float = SPREAD,
    ) -> None:
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
        draws = self._posterior.flat[:, i]
        noise = torch.randn(len(draws), generator=torch.Generator().manual_seed(seed), dtype=draws.dtype)
        return draws[:, 0] + draws[:, 1] * noise

    def each_car(self) -> tuple[Tensor, Tensor]:
        """Mean and standard deviation (quantity, car) of every car, given its own drives and its siblings'."""
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
    cars: Mapping[str, Sequence[Drive]], names: Sequence[str], quantities: Sequence[str], spread: float
) -> PopulationMargin:
    drives = [(number, drive) for number, name in enumerate(names) for drive in cars[name]]
    values, sd = (
        torch.tensor([[drive[q][part] for _, drive in drives] for q in quantities], dtype=torch.float64)
        for part in (0, 1)
    )
    return PopulationMargin(values, sd, torch.tensor([number for number, _ in drives]), spread=spread)


def population(cars: Mapping[str, Sequence[Drive]], seed: int = 0) -> tuple[dict[str, Any] | None, dict[str, Any]]:
    """What is common to the cars, and each car beside its siblings, by name; None and nothing below `FEWEST` cars."""
    if sum(bool(drives) for drives in cars.values()) < FEWEST:
        return None, {}
    pooling = Pooling(cars, QUANTITIES, seed)
    common: dict[str, Any] = {
        "cars": len(pooling.names),
        "drives": pooling.drives,
        "sampled_cars": pooling.sampled,
        "sampler": "sgld",
    }
    for i, name in enumerate(QUANTITIES):
        common[name] = {"typical": interval(pooling.mean[:, i].exp()), **pooling.spreads(i)}
    others, own = left_out(pooling.margin)
    means, sds = pooling.each_car()
    # smallest expected share of false ones at which each would be among those named (Benjamini and Hochberg 1995)
    apart = false_discovery_control((2 * own.amin(0)).clamp(max=1.0).numpy()).tolist()
    beside: dict[str, Any] = {}
    for c, name in enumerate(pooling.names):
        beside[name] = {"q_value": apart[c]}
        for i, quantity in enumerate(QUANTITIES):
            mean, sd = float(means[i, c]), float(sds[i, c])
            beside[name][quantity] = {
                "pooled": {
                    "median": math.exp(mean),
                    "q05": math.exp(mean - Z_90 * sd),
                    "q95": math.exp(mean + Z_90 * sd),
                },
                "ratio": math.exp(mean - float(others[i, c])),
                "tail": float(own[i, c]),
            }
    return common, beside


GRID = (32, 24)
"""Points of the grid over the spread between cars, and over that between drives."""

NARROWINGS = 3
"""Times that the grid is drawn in to where some car's belief is."""

WIDEST = (math.log(1e-3), math.log(4.0))
"""Of the logarithm of a spread."""

_OUTSIDE = 1e-9
"""Share of a belief that a grid that is drawn in may leave outside at either end."""


def left_out(margin: PopulationMargin) -> tuple[Tensor, Tensor]:
    """Of each car what its siblings predict, and the two-sided tail probability of its own drives under it.

    Both `(quantity, car)`; the prediction is the mean of the logarithm. The mean over cars has a normal belief in
    closed form once the spreads are given, so each car is left out exactly, at every point of a grid over the spreads:
    a car that counted among those that tell the spread would widen it and so hide itself.
    """
    found = [_left_out(margin.select(torch.tensor([i]))) for i in range(margin.windows)]
    return torch.stack([mean for mean, _ in found]), torch.stack([tail for _, tail in found])


def _left_out(margin: PopulationMargin) -> tuple[Tensor, Tensor]:
    between, within = (torch.linspace(*WIDEST, n, dtype=torch.float64) for n in GRID)
    if not margin.repeated:
        within = torch.full((1,), -math.inf, dtype=torch.float64)
    for _ in range(NARROWINGS):
        weight, *_ = _grid(margin, between, within)
        between = _narrowed(between, weight.sum(1))
        within = _narrowed(within, weight.sum(0)) if margin.repeated else within
    weight, below, centre = _grid(margin, between, within)
    share, over = (weight * below).sum((0, 1)), (weight * (1 - below)).sum((0, 1))
    return (weight * centre).sum((0, 1)), (2 * torch.minimum(share, over)).clamp(0.0, 1.0)


def _grid(margin: PopulationMargin, between: Tensor, within: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """`(between, within, car)`: belief in each point without the car, probability of an estimate below its own, and the
    mean over the other cars."""
    log_weight, below, centres = [], [], []
    for spread in within:
        mean, precision, left = (x[0] for x in margin.of_cars(spread.exp()[None]))
        variance = between.exp().square()[:, None] + 1 / precision
        w = 1 / variance
        # sums over all cars, less the car's own; the prior of the mean counts as one more, of mean 0
        total, weighted, square, logs = (
            x.sum(-1, keepdim=True) - x for x in (w, w * mean, w * mean.square(), w.log() + 2 * left)
        )
        total = total + 1 / MEAN_SD**2
        centre = weighted / total
        evidence = 0.5 * (logs - total.log() - square + weighted * centre)
        prior = 2 * between[:, None] - 2 / SPREAD * between[:, None].exp()
        if margin.repeated:
            prior = prior + 2 * spread - 2 / SPREAD * spread.exp()
        log_weight.append(evidence + prior)
        centres.append(centre)
        below.append(torch.special.ndtr((mean - centre) / (variance + 1 / total).sqrt()))
    log_weight = torch.stack(log_weight, 1)
    weight = log_weight.flatten(0, 1).softmax(0).unflatten(0, log_weight.shape[:2])
    return weight, torch.stack(below, 1), torch.stack(centres, 1)


def _narrowed(grid: Tensor, weight: Tensor) -> Tensor:
    """As many points between the outermost ones that some car's belief reaches; `weight` `(point, car)`."""
    inside = (weight.amax(1) > _OUTSIDE).nonzero().flatten()
    low, high = max(int(inside[0]) - 1, 0), min(int(inside[-1]) + 1, len(grid) - 1)
    return torch.linspace(float(grid[low]), float(grid[high]), len(grid), dtype=grid.dtype)


EFFECT_SPREAD = 0.5
"""What cars of a model are expected to differ by, in prior standard deviations. Of well-told cars that differ by 0.1,
0.3, 0.5 or 1 of these the 90 % interval of the next car holds 100, 94, 87 and 76 % where three cars are known, and 88
to 92 % where twenty are (`benchmarks.next_car`)."""


def drive_sizes(causes: Sequence[Mapping[str, Any]]) -> dict[str, Drive]:
    """Of each cause in a diagnosis' row what it says of the cause's parameters, by name."""
    found = {}
    for cause in causes:
        of_car = {p.name: p for p in _of_car(cause["name"])}
        told = {
            stats["name"]: belief
            for stats in cause["parameters"] or ()
            if stats["name"] in of_car and (belief := _belief(of_car[stats["name"]], stats)) is not None
        }
        if told:
            found[cause["name"]] = told
    return found


def effect_sizes(
    cause: str, cars: Mapping[str, Sequence[Mapping[str, Drive]]], seed: int = 0
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Of each parameter of `cause` the typical car, nine of ten cars and the spreads; and each car's own, by name.

    `cars`: of each car that has the cause, `drive_sizes` of its drives. Parameters that fewer than `FEWEST` cars tell
    are left out.
    """
    common: dict[str, Any] = {}
    each: dict[str, Any] = {}
    for parameter in _of_car(cause):
        name = parameter.name
        told = {car: [d[cause] for d in drives if name in d.get(cause, ())] for car, drives in cars.items()}
        if sum(bool(drives) for drives in told.values()) < FEWEST:
            continue
        pooling = Pooling(told, [name], seed, spread=EFFECT_SPREAD)
        common[name] = {
            "unit": parameter.unit,
            "cars": len(pooling.names),
            "drives": pooling.drives,
            "typical": interval(parameter.constrain(pooling.mean[:, 0])),
            "next_car": interval(parameter.constrain(pooling.next_car(0, seed))),
            **pooling.spreads(0),
        }
        means, sds = pooling.each_car()
        for c, car in enumerate(pooling.names):
            ends = (float(means[0, c]) + k * float(sds[0, c]) for k in (0.0, -Z_90, Z_90))
            middle, *sides = (_value(parameter, z) for z in ends)
            each.setdefault(car, {})[name] = {"median": middle, "q05": min(sides), "q95": max(sides)}
    return common, each


def _of_car(cause: str) -> list[Parameter]:
    """The parameters of an effect's answer that are the car's; none of an effect that is not registered here."""
    effect = EFFECTS.get(cause)
    if effect is None or effect.of_the_drive:
        return []
    return [p for p in (*effect.parameters, *effect.derived) if p.reported]


def _belief(parameter: Parameter, stats: Mapping[str, Any]) -> tuple[float, float] | None:
    """Mean and standard deviation of the coordinate; None of a value at the edge of what the parameter may be.

    From the ends of the 90 % interval where both are possible values: the mean of a skewed belief is not the middle of
    its coordinate.
    """
    ends = [stats.get(key) for key in ("value_q05", "value_q95")]
    if all(end is not None and math.isfinite(end) for end in ends):
        low, high = (float(z) for z in parameter.unconstrain(torch.tensor(ends, dtype=torch.float64)))
        if math.isfinite(low) and math.isfinite(high):
            return (low + high) / 2, max(abs(high - low) / (2 * Z_90), LEAST_SD)
    mean, sd = stats["value_mean"], stats["value_sd"]
    if mean is None or sd is None or not (math.isfinite(mean) and math.isfinite(sd)):
        return None
    value = torch.tensor(mean, dtype=torch.float64, requires_grad=True)
    z = parameter.unconstrain(value)
    if not bool(z.isfinite()):
        return None
    (slope,) = torch.autograd.grad(z, value)
    return float(z.detach()), max(abs(float(slope)) * sd, LEAST_SD)


def _value(parameter: Parameter, z: float) -> float:
    return float(parameter.constrain(torch.tensor(z, dtype=torch.float64)))
