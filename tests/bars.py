"""Bars of statistical tests: the allowed distance of a number from the truth, from the number of comparisons.

In one of a hundred runs of the whole suite a correct program may miss a bar. The comparisons share that evenly: each
may fail by chance in one of a million, and its bar lies 4.9 standard errors off, which comments round to 5 sigma. A
test that misses its bar is drawn once more; three such tests in one run, which fail it, have a probability of one in
several million.
"""

from __future__ import annotations

import math

from scipy import stats

ALARM = 0.01
"""Share of runs of the whole suite in which a bar is missed by chance."""
TESTS = 230
"""Test functions marked `statistical`; `tests/test_statistical.py` checks it against their number within a factor of
two."""
PER_TEST = 40
"""Comparisons of one: its cases, times windows, parameters, moments or lags. A factor of two moves the bar by 0.14."""
LEVEL = ALARM / (TESTS * PER_TEST)
"""Probability with which one comparison may fail by chance: the bar of a p-value."""


def sigmas(level: float = LEVEL) -> float:
    """Two-sided bar of a normal error, in standard errors."""
    return float(stats.norm.isf(level / 2))


BAR = sigmas()


def student(degrees: float, level: float = LEVEL) -> float:
    """The same where the standard error comes from so few numbers that it is uncertain itself."""
    return float(stats.t.isf(level / 2, degrees))


def log_odds(count: int = 1) -> float:
    """Upper bound on the largest of `count` log likelihood ratios against the truth [nats].

    A ratio's mean is 1 under the truth, so that it exceeds x nats with a probability of exp(-x) at most. It is most of
    its test, and has the level of a whole test.
    """
    return math.log(count / (PER_TEST * LEVEL))
