"""Do two signals of a log describe the same motion? The scale between a signal's change and the integral of its
rate."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

SPANS_S = (1.0, 4.0)  # the short one suits brisk drives, the long one averages more sensor noise
MIN_SPANS = 8
LATER_S = tuple(np.arange(1.1, 2.51, 0.1))
"""Delays [s] of a response later than a command is usually followed, up to 2.5 s."""
# a late car on a noisy manoeuvre of 30 s: 0.69 at its own delay, and -0.95 half a period earlier
_MAY_BE = 0.5


class Scale(NamedTuple):
    """``slope`` [-]: change of the first signal per integral of the second; ``correlation`` of the two; ``change``:
    standard deviation of the first one's changes, in its unit per second; ``spans``: how many separate ones."""

    slope: float
    correlation: float
    change: float
    spans: float

    @property
    def factor(self) -> float | None:
        """The factor by which the first signal surely changes more, or less, than the second implies; None where that
        may be 1.

        Noise in the second signal lowers the slope, noise in the first the slope of the inverse relation: the true
        factor lies between the two (Frisch 1934), give or take three standard errors.
        """
        r = self.correlation
        if r <= 0:
            return None
        error = 3.0 * math.sqrt(max(1 - r**2, 0.0) / self.spans) / r
        if self.slope * (1 - error) <= 1 <= self.slope / r**2 * (1 + error):
            return None
        return self.slope / r


class Line(NamedTuple):
    """An acceleration over a command: ``slope`` [-] and ``constant`` [m/s^2] with its standard error ``sd``, at their
    best ``correlation``."""

    slope: float
    constant: float
    sd: float
    correlation: float


def line_between(
    time: NDArray, parts: Sequence[slice], accel: NDArray, command: NDArray, *, delays: Sequence[float]
) -> Line | None:
    """Regress means of ``accel`` over the shorter of SPANS_S on those of ``command``, both ``(time,)``, before it by
    one of ``delays`` [s]; None where there are fewer than MIN_SPANS spans or the command does not move."""
    span, best = SPANS_S[0], None
    for delay in delays:
        means: list[NDArray] = []
        for part in parts:
            t = time[part]
            if len(t) < 3:
                continue
            at = np.arange(t[0] + delay, t[-1] - span, span)
            totals = [
                np.concatenate([[0.0], np.cumsum(0.5 * (y[1:] + y[:-1]) * np.diff(t))])
                for y in (accel[part], command[part])
            ]
            ends = (at, at - delay)
            means.append(
                np.stack(
                    [(np.interp(x + span, t, y) - np.interp(x, t, y)) / span for x, y in zip(ends, totals, strict=True)]
                )
            )
        a, u = np.concatenate(means, 1) if means else np.zeros((2, 0))
        if len(a) < MIN_SPANS or u.std() <= 1e-9 * (1 + np.abs(u).max()) or a.std() == 0:
            continue
        r = float(np.corrcoef(u, a)[0, 1])
        if best is None or r > best.correlation:
            slope = r * float(a.std() / u.std())
            left = float(np.sqrt(np.mean((a - a.mean() - slope * (u - u.mean())) ** 2)))
            sd = left / math.sqrt(len(a)) * math.sqrt(1 + float(u.mean() / u.std()) ** 2)
            best = Line(slope, float(a.mean() - slope * u.mean()), sd, r)
    return best


def scale_between(
    time: NDArray, parts: Sequence[slice], level: NDArray, rate: NDArray, *, delays: Sequence[float] = (0.0,)
) -> Scale | None:
    """Compare the changes of ``level`` over a span with the integral of ``rate`` over the same span, both ``(time,)``.

    ``parts`` are the stretches that may be used; of ``delays`` [s] of the response and of SPANS_S, the pair of best
    correlation counts. None where there are fewer than MIN_SPANS separate spans or one of the two signals does not
    move: the scale is then unknown.
    """
    totals = []
    for part in parts:
        t, y = time[part], rate[part]
        if len(t) > 2:
            totals.append((t, level[part], np.concatenate([[0.0], np.cumsum(0.5 * (y[1:] + y[:-1]) * np.diff(t))])))
    found = (_compare(totals, span, delay) for span in SPANS_S for delay in delays)
    return max((x for x in found if x is not None), key=_rank, default=None)


def may_be_late(correlation: Any, *, known: Any) -> Any:
    """Whether a response that looks inverted may be a late one, by its best `correlation` at LATER_S, where `known`.

    For a command that returns with the other sign after half a period, a late response cannot be distinguished from an
    inverted one: an inverted response counts only where one of the right sign, with up to 2.5 s of delay and lag, is
    known to correlate far less. Numbers, or arrays or tensors elementwise; bool.
    """
    return (known == 0) | (correlation >= _MAY_BE)


def late_response(time: NDArray, parts: Sequence[slice], level: NDArray, rate: NDArray) -> tuple[Scale | None, bool]:
    """For a response that looks inverted: the best one at LATER_S, None where unknown, and whether it may be the true
    one (`may_be_late`). Arguments as of `scale_between`.

    Short stretches know the smaller delays only; as the largest is unknown then, it may be the car's.
    """
    later = scale_between(time, parts, level, rate, delays=LATER_S)
    if later is None or scale_between(time, parts, level, rate, delays=LATER_S[-1:]) is None:
        return None, True
    return later, bool(may_be_late(later.correlation, known=True))


def _compare(totals: list[tuple[NDArray, NDArray, NDArray]], span: float, delay: float) -> Scale | None:
    changes, integrals, spans = [], [], 0.0
    for t, x, total in totals:
        starts = np.arange(t[0] + delay, t[-1] - span, span / 4)
        if len(starts):
            spans += (t[-1] - t[0] - delay) / span
            changes.append(np.interp(starts + span, t, x) - np.interp(starts, t, x))
            integrals.append(np.interp(starts + span - delay, t, total) - np.interp(starts - delay, t, total))
    if spans < MIN_SPANS:
        return None
    change, integral = np.concatenate(changes), np.concatenate(integrals)
    sx, sy = float(change.std()), float(integral.std())
    # a constant signal leaves rounding only
    if sx <= 1e-9 * (1 + np.abs(change).max()) or sy <= 1e-9 * (1 + np.abs(integral).max()):
        return None
    correlation = float(np.mean((change - change.mean()) * (integral - integral.mean())) / (sx * sy))
    return Scale(correlation * sx / sy, correlation, sx / span, spans)


def _rank(found: Scale) -> tuple[bool, float]:
    # a periodic drive correlates as strongly, with the other sign, half a period off: the agreeing sign goes first
    return found.correlation > 0.5, abs(found.correlation)
