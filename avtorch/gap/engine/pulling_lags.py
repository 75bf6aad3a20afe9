"""Lags by which an actuator may pull back what disturbs the car, and what its response says to each."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from avtorch.arrays import FloatArray
from avtorch.gap.engine.coordinates import INDEX
from avtorch.gap.engine.gauss_newton import penalty
from avtorch.gap.engine.hypothesis import Hypothesis
from avtorch.gap.engine.likelihood import claimed
from avtorch.gap.engine.priors import WITHIN_NATS

PULLING_LAG_RATIOS = 2.0 ** np.arange(6)
"""Lags over the actuator's own, by which a saturated actuator pulls back what disturbs it [-]."""
AT_LIMIT = 0.97
"""Share of the limit of jerk from which on it is at work [-]: a filter of the recorder rounds its corners."""


class PullingLags(NamedTuple):
    """Lags (lag,) [s] by which an actuator may pull back what disturbs the car, and what the response of the hypothesis
    loses with each [nats] (lag,)."""

    lag: FloatArray
    nats: FloatArray


def pulling_lags(h: Hypothesis) -> PullingLags:
    """Lags of an evaluated hypothesis with its `information`: its own, those that explain the response nearly as well,
    and longer ones while a limit of jerk is at work, for then the actuator does not answer.

    A drive with few steps hardly tells the lag, and the spectrum of the noise tells it, too: under one that is too
    short, process noise passes for a gust.
    """
    own, others = limited_lags(h), [*_other_lags(h, math.sqrt(2.0)), *_other_lags(h, math.sqrt(0.5))]
    lags = np.array([*own, *(lag for lag, _ in others)])
    return PullingLags(lags, np.array([*np.zeros(len(own)), *(nats for _, nats in others)]))


def _other_lags(h: Hypothesis, ratio: float) -> Iterator[tuple[float, float]]:
    """Lags by steps of a `ratio` from the hypothesis's own on, and what each loses [nats], to `WITHIN_NATS`; the other
    parameters follow to first order, or stay where that is better."""
    names, own = h.free, h["T_L"]
    k, n = names.index("T_L"), len(names)
    H = h.information[:n, :n]
    if 0.5 * (own * (math.sqrt(2.0) - 1)) ** 2 / np.linalg.inv(H)[k, k] > 4 * WITHIN_NATS:
        return  # the response tells it well
    rest = np.delete(np.arange(n), k)
    follow = -np.linalg.solve(H[np.ix_(rest, rest)], H[rest, k])
    claim, whole, prior = claimed(h.data, h.covariance), h.log_likelihood, penalty(h, names)
    lag = own * ratio
    while h.limits("T_L")[0] <= lag <= h.limits("T_L")[1]:
        nats = []
        for share in (1.0, 0.0):
            new = h.copy()
            new["T_L"] = lag
            for i, slope in zip(rest, follow, strict=True):
                low, high = h.limits(names[i])
                new[names[i]] = min(max(h[names[i]] + share * slope * (lag - own), low), high)
            new.evaluate()
            gain = min(claimed(new.data, new.covariance) - claim, new.log_likelihood - whole)
            nats.append(gain + penalty(new, names) - prior)
        if max(nats) < -WITHIN_NATS:
            return
        yield lag, min(max(nats), 0.0)
        lag *= ratio


def limited_lags(h: Hypothesis) -> FloatArray:
    """The actuator's own lag (lag,) [s], and longer ones by how often it is at a limit of jerk."""
    lag, inverse_jerk = h["T_L"], h["inverse_jerk"]
    if inverse_jerk <= 0 or h.data.accel is None:
        return np.array([lag])
    values = h.values.copy()
    values[[INDEX["accel_delay"], INDEX["accel_filter"]]] = 0.0
    slope = np.diff(h.rows(values)[0]) / np.diff(h.data.time)
    most = np.where(slope > 0, 1.0, np.exp(h["log_fall"])) / inverse_jerk
    limited = float((np.abs(slope) > AT_LIMIT * most).mean())
    return np.asarray(lag * (1 + limited * (PULLING_LAG_RATIOS - 1)), float)
