"""What chance does to test results: Wilson's intervals of shares, the bootstrap, the error of probabilities."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from statistics import NormalDist

import numpy as np

from avtorch.arrays import FloatArray, IntArray

Interval = tuple[float, float]
LEVEL = 0.90

_FEWEST = 30


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


def counted(hits: int, of: int) -> str:
    """How many of how many, with Wilson's 90 % interval of the share."""
    between = wilson(hits, of)
    return (
        f"{hits} of {of}" if between is None else f"{hits} of {of} ({100 * between[0]:.0f} to {100 * between[1]:.0f} %)"
    )


HALF_WIDTH = 0.05
"""Half width of an interval that is narrow enough to quote a figure with: 5 points."""


def cases_for(hits: int, trials: int, half: float = HALF_WIDTH, level: float = LEVEL) -> int:
    """Trials after which Wilson's interval of a share is `half` wide on either side; 268 for a share of a half.

    The share is planned with the middle of the interval at hand: two hits of two do not promise a share of 1. Without
    trials it is a half, the worst case. Where that many trials have been made it is enough.
    """
    interval = wilson(hits, trials, level) if trials else (0.0, 1.0)
    assert interval is not None
    z, share = NormalDist().inv_cdf(0.5 + level / 2), sum(interval) / 2
    if trials and (interval[1] - interval[0]) / 2 <= half:
        return trials

    def width(n: float) -> float:
        return z / (1 + z * z / n) * float(np.sqrt(share * (1 - share) / n + z * z / (4 * n * n)))

    low, high = 1, 2
    while width(high) > half:
        low, high = high, 2 * high
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if width(middle) > half else (low, middle)
    return high


def cases_for_mean(interval: Interval | None, cases: int, half: float = HALF_WIDTH) -> int | None:
    """Cases after which a bootstrapped interval is `half` wide on either side; None without an interval.

    Its width falls with the root of their number. At least 30: of a few like values the bootstrap promises too much.
    """
    if interval is None:
        return None
    now = (interval[1] - interval[0]) / 2
    return max(cases if now <= half else int(np.ceil(cases * (now / half) ** 2)), _FEWEST)


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


# How far probabilities are from the shares that turn out true, and how far few cases alone would put them.
_DRAWS = 1000


def calibration_error(probabilities: Sequence[float], true: Sequence[bool], bins: int = 10) -> float:
    """Expected calibration error: mean distance of probability and share that is true, over equal bins."""
    return float(_errors(np.array(probabilities), np.array(true, float)[None], bins)[0])


def calibration_by_chance(probabilities: Sequence[float], bins: int = 10, *, seed: int = 0) -> float:
    """The mean `calibration_error` where every one of these probabilities is exactly right.

    A bin of few cases never has its share to the digit, so the error of calibrated probabilities is not 0: what they
    say is drawn a thousand times (consistency resampling, Bröcker and Smith 2007).
    """
    stated = np.array(probabilities)
    drawn = np.random.default_rng(seed).random((_DRAWS, len(stated))) < stated
    return float(_errors(stated, drawn.astype(float), bins).mean())


def _errors(stated: FloatArray, true: FloatArray, bins: int) -> FloatArray:
    """Errors (draw,) of probabilities (case,), of which those are `true` (draw, case) that are 1 there."""
    which = np.minimum((stated * bins).astype(int), bins - 1)
    gaps = (stated - true) @ np.eye(bins)[which]  # (draw, bin)
    return np.asarray(np.abs(gaps).sum(1) / len(stated))
