"""The cars of a fleet partially pooled: their T_L and K_L, each car's belief, and how far it is from the others.

Logarithms of T_L and K_L are pooled, each by itself: the rows of a window have no covariance of the two.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from avtorch.fleet.pooling import FEWEST, Z_90, Drive, Pooling, interval
from avtorch.fleet.rows import Row

QUANTITIES = ("T_L", "K_L")

APART = 0.05
"""Expected share of false ones among the cars that are said to differ from their siblings."""

_LEAST_SD = 1e-3
"""Of a logarithm: no drive tells a lag better than to a thousandth."""


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
