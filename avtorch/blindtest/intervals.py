"""90 % intervals of test results: Wilson's for shares, the bootstrap for other measures."""

from __future__ import annotations

from collections.abc import Callable
from statistics import NormalDist

import numpy as np

from avtorch.arrays import IntArray

Interval = tuple[float, float]
LEVEL = 0.90


def wilson(hits: int, trials: int, level: float = LEVEL) -> Interval | None:
    """Wilson's score interval of a share; None without trials. Wilson, J. Am. Stat. Assoc. 22 (1927) 209."""
    if trials == 0:
        return None
    z = NormalDist().inv_cdf(0.5 + level / 2)
    share, weight = hits / trials, z * z / trials
    middle = (share + weight / 2) / (1 + weight)
    half = z / (1 + weight) * np.sqrt(share * (1 - share) / trials + weight / (4 * trials))
    low = 0.0 if hits == 0 else float(middle - half)
    return low, 1.0 if hits == trials else float(middle + half)


def bootstrap(
    measure: Callable[[IntArray], float | None],
    cases: int,
    *,
    resamples: int,
    seed: int,
    level: float = LEVEL,
) -> Interval | None:
    """Percentile bootstrap of `measure(index)` over `cases` drawn with replacement; None where it is undefined."""
    if cases == 0:
        return None
    rng = np.random.default_rng(seed)
    values = [measure(rng.integers(cases, size=cases)) for _ in range(resamples)]
    known = [value for value in values if value is not None]
    if not known:
        return None
    low, high = np.quantile(known, [0.5 - level / 2, 0.5 + level / 2])
    return float(low), float(high)
