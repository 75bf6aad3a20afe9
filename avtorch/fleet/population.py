"""The cars of a fleet beside one another: partially pooled T_L and K_L, whose a cause is, and how large it is.

SGLD walks over mean and spreads, then each car follows in closed form. Each quantity is pooled by itself, in a
coordinate in which cars vary normally: the logarithm of a lag or gain, or that of the prior of an effect's parameter,
in which typical sizes have a standard deviation of one. Parameters that belong to the drive (a road, the row at which a
gain changes) are no car's and are left out.

A car has a cause where more than half of its diagnosed drives name it. Of `have` cars among `diagnosed`, the share of
all such cars has the belief Beta(have + 1/2, diagnosed - have + 1/2), from Jeffreys' prior.
"""

from __future__ import annotations

import math
import random
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from avtorch.fleet.folder import Row

if TYPE_CHECKING:
    from torch import Tensor

    from avtorch.gap.simulator.parameter import Parameter
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


QUANTITIES = ("T_L", "K_L")

APART = 0.05
"""Expected share of false ones among the cars that are said to differ from their siblings."""

_LEAST_SD = 1e-3
"""Of a coordinate: no drive tells a lag or the size of an effect better than to a thousandth."""


def drive_belief(used: Sequence[Row]) -> Drive | None:
    """What the used windows of a drive say of log T_L and log K_L; None where an estimator gives no SD.

    The standard deviation of their mean is by what the windows differ by, or by what their posteriors say, whichever is
    more. What windows of a drive have in common is the spread from drive to drive.
    """
    found = {}
    for name in QUANTITIES:
        means, variances = [], []
        for row in used:
            mean, sd = row[f"{name}_mean"], row[f"{name}_sd"]
            if mean is None or sd is None or not (math.isfinite(mean) and math.isfinite(sd) and mean > 0):
                return None
            variances.append(math.log1p((sd / mean) ** 2))
            means.append(math.log(mean) - variances[-1] / 2)
        count = len(means)
        if not count:
            return None
        mean = sum(means) / count
        spread = sum((x - mean) ** 2 for x in means) / max(1, count - 1)
        variance = max(spread, sum(variances) / count) / count
        found[name] = (mean, max(math.sqrt(variance), _LEAST_SD))
    return found


def population(cars: Mapping[str, Sequence[Drive]], seed: int = 0) -> tuple[dict[str, Any] | None, dict[str, Any]]:
    """What is common to the cars, and each car beside its siblings, by name; None and nothing below `FEWEST` cars."""
    if sum(bool(drives) for drives in cars.values()) < FEWEST:
        return None, {}
    from avtorch.fleet.siblings import left_out

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
    apart = _q_values((2 * own.amin(0)).clamp(max=1.0).tolist())
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


def _q_values(p: Sequence[float]) -> list[float]:
    """Smallest expected share of false ones at which each would be among those named (Benjamini and Hochberg 1995)."""
    order = sorted(range(len(p)), key=p.__getitem__, reverse=True)
    found, least = [1.0] * len(p), 1.0
    for place, i in enumerate(order):
        least = min(least, p[i] * len(p) / (len(p) - place))
        found[i] = least
    return found


COMMON, SINGLE = 2 / 3, 1 / 3
"""The model's: the 90 % interval of the share of cars is above the first. Single cars': below the second."""

VERDICTS = ("the model's", "single cars'", "not decided")

Diagnosed = Mapping[str, Any]
"""A drive's `named` causes, and those `alike`, which its log cannot tell from them."""


def car_causes(drives: Sequence[Diagnosed]) -> tuple[list[str], list[str]]:
    """The causes that a car has by most of its drives, and those that it may have instead of them."""
    return _mostly(drives, "named"), _mostly(drives, "alike")


def _mostly(drives: Sequence[Diagnosed], key: str) -> list[str]:
    names = {name for drive in drives for name in drive[key]}
    return sorted(name for name in names if 2 * sum(name in drive[key] for drive in drives) > len(drives))


def fleet_causes(cars: Mapping[str, tuple[Sequence[str], Sequence[str]]]) -> list[dict[str, Any]]:
    """The causes that some car has, the most common first: how many cars, the share's interval, and whose it is.

    `cars`: of each diagnosed car what `car_causes` returns. A cause is single cars' only if those that may have it in
    place of another are few as well.
    """
    count = len(cars)
    found = []
    for name in sorted({n for named, _ in cars.values() for n in named}):
        have = [car for car, (named, _) in cars.items() if name in named]
        may = sum(name in {*named, *alike} for named, alike in cars.values())
        share, most = _share(len(have), count), _share(may, count)
        verdict = "not decided"
        if share["q05"] > COMMON:
            verdict = "the model's"
        elif most["q95"] < SINGLE:
            verdict = "single cars'"
        one: dict[str, Any] = {"name": name, "cars": len(have), "may": may, "diagnosed": count, "share": share}
        found.append(one | {"verdict": verdict, "of": have if verdict == "single cars'" else None})
    return sorted(found, key=lambda one: (-one["cars"], one["name"]))


def _share(have: int, count: int) -> dict[str, float]:
    from scipy.special import betaincinv

    a, b = have + 0.5, count - have + 0.5
    return {"mean": a / (a + b), "q05": float(betaincinv(a, b, 0.05)), "q95": float(betaincinv(a, b, 0.95))}


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
    from avtorch.gap import EFFECTS

    effect = EFFECTS.get(cause)
    if effect is None or effect.of_the_drive:
        return []
    return [p for p in (*effect.parameters, *effect.derived) if p.reported and p.constraint != "interval"]


def _belief(parameter: Parameter, stats: Mapping[str, Any]) -> tuple[float, float] | None:
    """Mean and standard deviation of the coordinate; None of a value at the edge of what the parameter may be.

    From the ends of the 90 % interval where both are possible values: the mean of a skewed belief is not the middle of
    its coordinate.
    """
    import torch

    ends = [stats.get(key) for key in ("value_q05", "value_q95")]
    if all(end is not None and math.isfinite(end) for end in ends):
        low, high = (float(z) for z in parameter.unconstrain(torch.tensor(ends, dtype=torch.float64)))
        if math.isfinite(low) and math.isfinite(high):
            return (low + high) / 2, max(abs(high - low) / (2 * Z_90), _LEAST_SD)
    mean, sd = stats["value_mean"], stats["value_sd"]
    if mean is None or sd is None or not (math.isfinite(mean) and math.isfinite(sd)):
        return None
    value = torch.tensor(mean, dtype=torch.float64, requires_grad=True)
    z = parameter.unconstrain(value)
    if not bool(z.isfinite()):
        return None
    (slope,) = torch.autograd.grad(z, value)
    return float(z.detach()), max(abs(float(slope)) * sd, _LEAST_SD)


def _value(parameter: Parameter, z: float) -> float:
    import torch

    return float(parameter.constrain(torch.tensor(z, dtype=torch.float64)))
