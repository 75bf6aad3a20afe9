"""How large a cause is in the cars that have it: its parameters, partially pooled over cars and drives.

A parameter is pooled in the coordinate of its prior, in which typical sizes have a standard deviation of one: the
logarithm of a dead time, a bias as it is. Parameters that belong to the drive (a road, the row at which a gain changes)
are no car's and are left out.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from avtorch.fleet.pooling import FEWEST, Z_90, Drive, Pooling, interval

if TYPE_CHECKING:
    from avtorch.gap.simulator.parameter import Parameter

SPREAD = 0.5
"""What cars of a model are expected to differ by, in prior standard deviations. Of well-told cars that differ by 0.1,
0.3, 0.5 or 1 of these the 90 % interval of the next car holds 100, 94, 87 and 76 % where three cars are known, and 88
to 92 % where twenty are (`benchmarks.next_car`)."""

_LEAST_SD = 1e-3  # of the prior's: no drive tells a size better


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
        pooling = Pooling(told, [name], seed, spread=SPREAD)
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
