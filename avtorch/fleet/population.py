"""The cars of a fleet partially pooled: their T_L and K_L, each car's belief, and how far it is from the others.

Logarithms of T_L and K_L are pooled, each by itself: the rows of a window have no covariance of the two.
"""

from __future__ import annotations

import math
import random
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from avtorch.fleet.rows import Row

if TYPE_CHECKING:
    from torch import Tensor

    from avtorch.inference.population import PopulationMargin

QUANTITIES = ("T_L", "K_L")

FEWEST = 3
"""Cars from which there are siblings to compare with."""

SAMPLED = 200
"""Cars that SGLD walks over at most, drawn at random from more: they tell the spread between cars to 5 %."""

APART = 0.05
"""Expected share of false ones among the cars that are said to differ from their siblings."""

_LEAST_SD = 1e-3
"""Of a logarithm: no drive tells a lag better than to a thousandth."""

_Z = 1.6448536269514722  # of the 95 % quantile

Drive = Mapping[str, tuple[float, float]]
"""Mean and standard deviation of the logarithm of each quantity."""


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
    names = [name for name, drives in cars.items() if drives]
    if len(names) < FEWEST:
        return None, {}
    import torch

    from avtorch.fleet.siblings import left_out
    from avtorch.inference import SamplerSettings, sample

    margin = _margin(cars, names)
    few = margin if len(names) <= SAMPLED else _margin(cars, random.Random(seed).sample(names, SAMPLED))
    # its draws are also what every car is drawn in by: fewer and longer chains than for one window
    settings = SamplerSettings(chains=64, draws=64, burn_in=16)
    posterior = sample(few, settings, generator=torch.Generator().manual_seed(seed))
    common: dict[str, Any] = {
        "cars": len(names),
        "drives": sum(len(cars[name]) for name in names),
        "sampled_cars": few.cars,
        "sampler": "sgld",
    }
    for i, name in enumerate(QUANTITIES):
        draws = posterior.flat[:, i]
        spreads = {key: _interval(draws[:, k]) for k, key in enumerate(few.hyper) if k}
        # drives that were not repeated, by chance among those drawn, leave no spread between drives
        common[name] = {"typical": _interval(draws[:, 0].exp()), "between": spreads["between"]}
        common[name] |= {"within": spreads.get("within"), "converged": bool(posterior.converged[i])}
        common[name]["why"] = "" if posterior.converged[i] else posterior.why[i]
    others, own = left_out(margin)
    means, sds = _pooled(margin, posterior.flat[::16], few.repeated)
    apart = _q_values((2 * own.amin(0)).clamp(max=1.0).tolist())
    beside: dict[str, Any] = {}
    for c, name in enumerate(names):
        beside[name] = {"q_value": apart[c]}
        for i, quantity in enumerate(QUANTITIES):
            mean, sd = float(means[i, c]), float(sds[i, c])
            beside[name][quantity] = {
                "pooled": {"median": math.exp(mean), "q05": math.exp(mean - _Z * sd), "q95": math.exp(mean + _Z * sd)},
                "ratio": math.exp(mean - float(others[i, c])),
                "tail": float(own[i, c]),
            }
    return common, beside


def _margin(cars: Mapping[str, Sequence[Drive]], names: Sequence[str]) -> PopulationMargin:
    import torch

    from avtorch.inference.population import PopulationMargin

    drives = [(number, drive) for number, name in enumerate(names) for drive in cars[name]]
    values, sd = (
        torch.tensor([[drive[q][part] for _, drive in drives] for q in QUANTITIES], dtype=torch.float64)
        for part in (0, 1)
    )
    return PopulationMargin(values, sd, torch.tensor([number for number, _ in drives]))


def _pooled(margin: PopulationMargin, draws: Tensor, repeated: bool) -> tuple[Tensor, Tensor]:
    """Mean and SD `(quantity, car)` of the logarithm of each car, over `draws` `(draw, quantity, parameter)`."""
    import torch

    z = torch.cat([draws[..., :1], draws[..., 1:].log()], -1)
    if margin.repeated and not repeated:
        z = torch.cat([z, torch.full_like(z[..., :1], -math.inf)], -1)
    first = second = inside = torch.zeros((), dtype=torch.float64)
    for one in z:  # each of all cars: memory for one draw at a time
        mean, variance = margin.cars_given(one)
        first, second, inside = first + mean, second + mean.square(), inside + variance
    first, second, inside = first / len(z), second / len(z), inside / len(z)
    return first, (inside + (second - first.square()).clamp_min(0.0)).sqrt()


def _interval(draws: Tensor) -> dict[str, float]:
    ordered = draws.sort().values
    at = (float(ordered[round(q * (len(ordered) - 1))]) for q in (0.5, 0.05, 0.95))
    return dict(zip(("median", "q05", "q95"), at, strict=True))


def _q_values(p: Sequence[float]) -> list[float]:
    """Smallest expected share of false ones at which each would be among those named (Benjamini and Hochberg 1995)."""
    order = sorted(range(len(p)), key=p.__getitem__, reverse=True)
    found, least = [1.0] * len(p), 1.0
    for place, i in enumerate(order):
        least = min(least, p[i] * len(p) / (len(p) - place))
        found[i] = least
    return found
