"""The cars of a fleet beside one another: partially pooled T_L and K_L, and how large a cause is.

A drive's estimate varies about its car's by its own standard deviation and from drive to drive; cars vary about their
model's mean (Gelman et al., Bayesian Data Analysis, chapter 5):

    y_drive ~ Normal(car, sd_drive² + within²),    car ~ Normal(mean, between²)

with priors Normal(0, 2²) of the mean and Gamma(2, 2 / spread) of the spreads. Each quantity is pooled by itself, in a
coordinate in which cars vary normally: the logarithm of a lag or gain, or that of the prior of an effect's parameter,
in which typical sizes have a standard deviation of one. Parameters that belong to the drive (a road, the row at which a
gain changes) are no car's and are left out.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from scipy.interpolate import PchipInterpolator
from scipy.stats import false_discovery_control
from torch import Tensor
from torch.nn.functional import pad

from avtorch.fleet.folder import LEAST_SD, QUANTITIES, Drive
from avtorch.gap import EFFECTS
from avtorch.gap.simulator.parameter import Parameter

MEAN_SD = 2.0
"""Prior standard deviation of the mean of a logarithm, about 0: a lag within a factor of 50 about a second."""

SPREAD = 0.2
"""Prior mean of the spreads, whose prior is Gamma(2, 2 / mean): lags of a model's cars differ by a fifth or so, and not
by nothing."""

FEWEST = 3
"""Cars from which there are siblings to compare with."""

Z_90 = 1.6448536269514722
"""Standard deviations from a normal's mean to its 5 and 95 % quantiles."""

GRID = (32, 24)
"""Points of the grid over the spread between cars, and over that between drives."""

NARROWINGS = 3
"""Times that the grid is drawn in to where some belief is."""

WIDEST = (math.log(1e-3), math.log(4.0))
"""Of the logarithm of a spread."""

_OUTSIDE = 1e-9
"""Share of a belief that a grid that is drawn in may leave outside at either end."""
_LEVELS = (0.5, 0.05, 0.95)
_POINTS = 2001  # of a distribution function, of which quantiles are read


class Pooled:
    """One quantity of cars by the estimates `values` (drive,) of its logarithm, their standard deviations `sd` (drive,)
    and the number `car` (drive,) of each drive's car, from 0 without a gap; `spread`: what cars are expected to differ
    by.

    The mean over cars has a normal belief in closed form once the spreads are given, and so has each car. The belief in
    the spreads is the `weight` (between, within, left out) of each point of a grid: without each car in turn, and last
    without none. A car that counted among those that tell the spread would widen it and so hide itself. Where no car
    has two drives, the spread between these is part of that between cars.
    """

    def __init__(self, values: Tensor, sd: Tensor, car: Tensor, spread: float = SPREAD) -> None:
        self.values, self.sd, self.car, self.spread = values, sd, car, spread
        self.repeated = int(car.max()) + 1 < len(car)
        self.between, self.within = (torch.linspace(*WIDEST, n, dtype=torch.float64) for n in GRID)
        if not self.repeated:
            self.within = torch.full((1,), -math.inf, dtype=torch.float64)
        self._weigh()
        for _ in range(NARROWINGS):
            self.between = _narrowed(self.between, self.weight.sum(1))
            if self.repeated:
                self.within = _narrowed(self.within, self.weight.sum(0))
            self._weigh()

    def _weigh(self) -> None:
        """Belief in each point, and what each tells of the mean over cars: `centre`, `precision`."""
        # what the drives of each car say together (within, car), and what is left of their density
        v = self.sd.square() + self.within.exp().square()[:, None]
        self.own_precision = self._summed(1 / v)
        self.own = self._summed(self.values / v) / self.own_precision
        left = self._summed(v.log() + (self.values - self.own[:, self.car]).square() / v) + self.own_precision.log()
        self.variance = self.between.exp().square()[:, None, None] + 1 / self.own_precision
        w = 1 / self.variance
        # sums over all cars, less the one left out; the prior of the mean counts as one more, of mean 0
        total, weighted, square, logs = (
            x.sum(-1, keepdim=True) - pad(x, (0, 1)) for x in (w, w * self.own, w * self.own.square(), w.log() - left)
        )
        self.precision = total + 1 / MEAN_SD**2
        self.centre = weighted / self.precision
        log_weight = 0.5 * (logs - self.precision.log() - square + weighted * self.centre)
        log_weight = log_weight + self._log_prior(self.between)[:, None, None]
        if self.repeated:
            log_weight = log_weight + self._log_prior(self.within)[:, None]
        self.weight = log_weight.flatten(0, 1).softmax(0).unflatten(0, log_weight.shape[:2])

    def _summed(self, x: Tensor) -> Tensor:
        """(within, car) of what drives (within, drive) have."""
        return x.new_zeros(len(x), int(self.car.max()) + 1).index_add(-1, self.car, x)

    def _log_prior(self, spread: Tensor) -> Tensor:
        """Gamma(2, 2 / mean) of a spread, in its logarithm."""
        return 2 * spread - 2 / self.spread * spread.exp()

    def siblings(self) -> tuple[Tensor, Tensor]:
        """Of each car (car,) what its siblings predict, and the two-sided tail of its own drives under that."""
        weight, centre, precision = (x[..., :-1] for x in (self.weight, self.centre, self.precision))
        below = torch.special.ndtr((self.own - centre) / (self.variance + 1 / precision).sqrt())
        share, over = (weight * below).sum((0, 1)), (weight * (1 - below)).sum((0, 1))
        return (weight * centre).sum((0, 1)), (2 * torch.minimum(share, over)).clamp(0.0, 1.0)

    def each_car(self) -> tuple[Tensor, Tensor]:
        """Mean and standard deviation (car,) of every car, given its own drives and its siblings'."""
        weight, centre, precision = (x[..., -1:] for x in (self.weight, self.centre, self.precision))
        rest = 1 / (self.own_precision * self.variance)  # what is left to the mean over cars
        mean = (1 - rest) * self.own + rest * centre
        variance = (1 - rest) / self.own_precision + rest.square() / precision
        first = (weight * mean).sum((0, 1))
        return first, (weight * (variance + mean.square())).sum((0, 1)).sub(first.square()).clamp_min(0.0).sqrt()

    def typical(self) -> list[float]:
        """Median, 5 and 95 % quantile of the mean over cars."""
        return self._quantiles(1 / self.precision[..., -1])

    def next_car(self) -> list[float]:
        """The same of a car of the model that was not driven."""
        return self._quantiles(1 / self.precision[..., -1] + self.between.exp().square()[:, None])

    def _quantiles(self, variance: Tensor) -> list[float]:
        """Of normals about `centre` with a variance (between, within), mixed."""
        weight, centre, sd = (x.flatten() for x in (self.weight[..., -1], self.centre[..., -1], variance.sqrt()))
        ends = float((centre - 5 * sd).min()), float((centre + 5 * sd).max())
        x = torch.linspace(*ends, _POINTS, dtype=torch.float64)
        below = torch.special.ndtr((x[:, None] - centre) / sd) @ weight
        return np.interp(_LEVELS, below.numpy(), x.numpy()).tolist()

    def spreads(self) -> dict[str, Any]:
        """How far cars differ, and how far drives of one car do (None where no car has two)."""
        weight = self.weight[..., -1]
        within = _spread(self.within, weight.sum(0)) if self.repeated else None
        return {"between": _spread(self.between, weight.sum(1)), "within": within, "converged": True, "why": ""}


def _narrowed(grid: Tensor, weight: Tensor) -> Tensor:
    """As many points between the outermost ones that some belief reaches; `weight` `(point, left out)`."""
    inside = (weight.amax(1) > _OUTSIDE).nonzero().flatten()
    low, high = max(int(inside[0]) - 1, 0), min(int(inside[-1]) + 1, len(grid) - 1)
    return torch.linspace(float(grid[low]), float(grid[high]), len(grid), dtype=grid.dtype)


def _spread(grid: Tensor, weight: Tensor) -> dict[str, float]:
    """Of a spread by the weight (point,) of each of its logarithms, which is that of the step about it."""
    edges = (grid + 0.5 * (grid[1] - grid[0])).numpy()
    x = np.linspace(edges[0], edges[-1], _POINTS)
    below = PchipInterpolator(edges, weight.cumsum(0).numpy())(x)
    return _interval(np.interp(_LEVELS, below, x).tolist(), torch.exp)


def _interval(coordinate: Sequence[float], constrain: Callable[[Tensor], Tensor]) -> dict[str, float]:
    """Median, 5 and 95 % quantile of a quantity, by those of its coordinate."""
    middle, *sides = constrain(torch.tensor(coordinate, dtype=torch.float64)).tolist()
    return {"median": middle, "q05": min(sides), "q95": max(sides)}


def pooled(cars: Mapping[str, Sequence[Drive]], quantity: str, spread: float = SPREAD) -> Pooled:
    """A quantity of cars, all of which have drives; `spread`: what cars are expected to differ by."""
    told = [(number, *drive[quantity]) for number, drives in enumerate(cars.values()) for drive in drives]
    number, values, sd = torch.tensor(told, dtype=torch.float64).T
    return Pooled(values, sd, number.long(), spread)


def _each_car(
    found: Pooled, names: Sequence[str], constrain: Callable[[Tensor], Tensor]
) -> dict[str, dict[str, float]]:
    """The interval of each car, by name."""
    means, sds = (x.tolist() for x in found.each_car())
    return {
        name: _interval((mean, mean - Z_90 * sd, mean + Z_90 * sd), constrain)
        for name, mean, sd in zip(names, means, sds, strict=True)
    }


def population(cars: Mapping[str, Sequence[Drive]]) -> tuple[dict[str, Any] | None, dict[str, Any]]:
    """What is common to the cars, and each car beside its siblings, by name; None and nothing below `FEWEST` cars."""
    cars = {name: drives for name, drives in cars.items() if drives}
    if len(cars) < FEWEST:
        return None, {}
    common: dict[str, Any] = {"cars": len(cars), "drives": sum(map(len, cars.values()))}
    common |= {"sampled_cars": len(cars), "sampler": "grid"}
    beside: dict[str, Any] = {name: {} for name in cars}
    tails = []
    for quantity in QUANTITIES:
        found = pooled(cars, quantity)
        common[quantity] = {"typical": _interval(found.typical(), torch.exp), **found.spreads()}
        others, tail = found.siblings()
        each = _each_car(found, list(cars), torch.exp)
        for (name, own), other, share in zip(each.items(), others.tolist(), tail.tolist(), strict=True):
            ratio = own["median"] / math.exp(other)
            beside[name][quantity] = {"pooled": own, "ratio": ratio, "tail": share}
        tails.append(tail)
    # smallest expected share of false ones at which each would be among those named (Benjamini and Hochberg 1995)
    apart = false_discovery_control((2 * torch.minimum(*tails)).clamp(max=1.0).numpy()).tolist()
    return common, {name: {"q_value": q, **beside[name]} for name, q in zip(cars, apart, strict=True)}


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
    cause: str, cars: Mapping[str, Sequence[Mapping[str, Drive]]]
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
        told = {car: drives for car, drives in told.items() if drives}
        if len(told) < FEWEST:
            continue
        found = pooled(told, name, EFFECT_SPREAD)
        common[name] = {
            "unit": parameter.unit,
            "cars": len(told),
            "drives": sum(map(len, told.values())),
            "typical": _interval(found.typical(), parameter.constrain),
            "next_car": _interval(found.next_car(), parameter.constrain),
            **found.spreads(),
        }
        for car, own in _each_car(found, list(told), parameter.constrain).items():
            each.setdefault(car, {})[name] = own
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
