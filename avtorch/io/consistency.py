"""Do two signals of a log tell the same motion? The scale between a signal's change and the integral of its rate."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

SPAN_S = 1.0  # long enough to average sensor noise, short enough that the fall-off of a real bias does not matter
MIN_SPANS = 8


class Scale(NamedTuple):
    """``slope`` [-]: change of the first signal per integral of the second; ``correlation`` of the two; ``change``:
    standard deviation of the first one's changes over SPAN_S, in its unit."""

    slope: float
    correlation: float
    change: float


def scale_between(
    time: NDArray, parts: Sequence[slice], level: NDArray, rate: NDArray, *, delays: Sequence[float] = (0.0,)
) -> Scale | None:
    """Compare the changes of ``level`` over SPAN_S with the integral of ``rate`` over the same spans, both ``(time,)``.

    ``parts`` are the stretches that may be used; of ``delays`` [s] of the response, the one of best correlation counts.
    None where there are fewer than MIN_SPANS separate spans or one of the two does not move: then nothing can be said.
    """
    best: Scale | None = None
    for delay in delays:
        changes, integrals, spans = [], [], 0.0
        for part in parts:
            t, x, y = time[part], level[part], rate[part]
            if len(t) < 3:
                continue
            total = np.concatenate([[0.0], np.cumsum(0.5 * (y[1:] + y[:-1]) * np.diff(t))])
            starts = np.arange(t[0] + delay, t[-1] - SPAN_S, SPAN_S / 4)
            if len(starts) == 0:
                continue
            spans += (t[-1] - t[0] - delay) / SPAN_S
            changes.append(np.interp(starts + SPAN_S, t, x) - np.interp(starts, t, x))
            integrals.append(np.interp(starts + SPAN_S - delay, t, total) - np.interp(starts - delay, t, total))
        if spans < MIN_SPANS:
            continue
        change, integral = np.concatenate(changes), np.concatenate(integrals)
        sx, sy = float(change.std()), float(integral.std())
        # a constant signal leaves rounding only
        if sx <= 1e-9 * (1 + np.abs(change).max()) or sy <= 1e-9 * (1 + np.abs(integral).max()):
            continue
        correlation = float(np.mean((change - change.mean()) * (integral - integral.mean())) / (sx * sy))
        # a periodic drive correlates as strongly, with the other sign, half a period off: the agreeing sign goes first
        if best is None or _rank(correlation) > _rank(best.correlation):
            best = Scale(correlation * sx / sy, correlation, sx)
    return best


def _rank(correlation: float) -> tuple[bool, float]:
    return correlation > 0.5, abs(correlation)
