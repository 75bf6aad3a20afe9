r"""Lost messages: stretches of rows in which the car is better explained by the last command that arrived.

Where the messages of rows i to j - 1 are lost, the demand changes by w_k = K (u_{i-1} - u_k), i <= k < j: no parameter
is free. A set of stretches gains

    G = s' w - 1/2 w' A w - price (stretches),

s and A being score and information of `demand_filter`, the price that of `evidence.lost_nats`. Pulses that do not
overlap in A add up, and the best set of disjoint stretches is then a weighted interval scheduling (Kleinberg and Tardos
2006, ch. 6.1; Viterbi's recursion of a semi-Markov chain). What the tails of close stretches share is settled
afterwards: each stretch in turn is moved, resized or dropped given all others, until nothing gains (iterated
conditional modes; Besag 1986); `nats` is G itself.

The residual with its sign turned around is a negative control: noise gains as much there, lost messages nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from avtorch.arrays import BoolArray, FloatArray, IntArray
from avtorch.gap.engine.demand_filter import (
    demand_information,
    demand_score,
    frame_cover,
    pulse_energy,
    response_rows,
    take_out,
)
from avtorch.gap.engine.evidence import evaluate_evidence, lost_nats
from avtorch.gap.engine.gauss_newton import fit
from avtorch.gap.engine.hypothesis import Hypothesis
from avtorch.gap.engine.priors import LOST_S, WARM_S

_SWEEPS = 6  # of conditional modes; three are enough for most drives
_ROUNDS = 3  # of stretches given parameters, parameters given stretches


class LostMessages(NamedTuple):
    """Stretches `rows` ((from, to), ...) of lost messages, `to` exclusive, and what they gain in all, `nats`."""

    nats: float
    rows: tuple[tuple[int, int], ...]


def lost_messages(h: Hypothesis, sign: float = 1.0, mask: BoolArray | None = None) -> LostMessages:
    """The best set of lost stretches under the parameters and the noise of a hypothesis that has been evaluated.

    `sign`: -1 for the negative control. `mask` (row,): rows whose residual has another cause; no stretch responds
    there. Stretches that the hypothesis holds lost are looked for anew.
    """
    data, residual = h.data, h.residual
    if h.lost:
        sent = h.copy()
        sent.lost = ()
        residual = data.measured - sent.response()
    m = pulse_model(h, mask)
    score = demand_score(h, h.covariance, sign * residual)
    rows = best_stretches(m, score)
    return LostMessages(gain_of(m, score, rows), tuple(rows))


def with_lost_messages(h: Hypothesis, mask: BoolArray | None = None) -> Hypothesis | None:
    """The hypothesis with `command_hold` and its lost stretches, fitted and with its evidence; None where the negative
    control gains as much.

    Parameters and stretches are found in turn: fewer errors of one show more of the other.
    """
    found = lost_messages(h, mask=mask)
    if found.nats < lost_nats(h) or found.nats - lost_messages(h, -1.0, mask).nats < lost_nats(h):
        return None
    best: Hypothesis | None = None
    for _ in range(_ROUNDS):
        trial = h.with_effect("command_hold", ()) if best is None else best.copy()
        trial.lost = found.rows
        trial = fit(trial, 6)
        evaluate_evidence(trial)
        if best is not None and trial.score <= best.score:
            break
        best = trial
        found = lost_messages(best, mask=mask)
        if found.rows == best.lost:
            break
    return best


# sets of stretches -------------------------------------------------------------------------------------------------
class PulseModel(NamedTuple):
    """What the gain of a stretch depends on beside the score.

    `demand` (row,) [m/s²] as sent; `information` (lag,) and `cover` (row,) of `demand_filter`; `free` (row,): the first
    row from each row on in which the residual has another cause; `longest`: most rows of a stretch, `tail`: rows of
    response behind it that have no other cause; `penalty` of a stretch [nats].
    """

    demand: FloatArray
    information: FloatArray
    cover: FloatArray
    free: IntArray
    longest: int
    tail: int
    penalty: float


def pulse_model(h: Hypothesis, mask: BoolArray | None = None) -> PulseModel:
    """The model under a hypothesis; no stretch responds in the rows of `mask` (row,)."""
    data = h.data
    information = demand_information(h, h.covariance, round(WARM_S / data.dt))
    blocked = data.starts if mask is None else data.starts | mask
    rows = np.where(blocked, np.arange(len(blocked)), len(blocked))
    return PulseModel(
        demand=h["K_L"] * data.command,
        information=information,
        cover=frame_cover(h),
        free=np.ascontiguousarray(np.minimum.accumulate(rows[::-1])[::-1]),
        longest=max(1, min(round(LOST_S / data.dt), len(information) - 1)),
        tail=response_rows(h),
        penalty=lost_nats(h),
    )


def best_stretches(m: PulseModel, score: FloatArray) -> list[tuple[int, int]]:
    """The set of stretches of largest G under the `score` (row,), [(from, to)] in order."""
    first, stop, gain = candidates(m, score, 1, len(m.demand))
    # one lag apart at first: tails that overlap would be counted twice
    chosen = schedule(first, stop, gain - m.penalty, max(1, m.tail // 3))
    begin = np.zeros(len(score) + 1, np.int64)
    end = np.zeros(len(score) + 1, np.int64)
    begin[: len(chosen)], end[: len(chosen)] = first[chosen], stop[chosen]
    count = _conditional_modes(m, score.copy(), begin, end, len(chosen), _SWEEPS)
    return list(zip(begin[:count].tolist(), end[:count].tolist(), strict=True))


def gain_of(m: PulseModel, score: FloatArray, rows: Sequence[tuple[int, int]]) -> float:
    """G of a set of disjoint stretches [nats]."""
    if not rows:
        return 0.0
    at = np.concatenate([np.arange(i, j) for i, j in rows])
    w = np.concatenate([m.demand[i - 1] - m.demand[i:j] for i, j in rows])
    return float(score[at] @ w) - 0.5 * pulse_energy(m.information, m.cover, at, w) - m.penalty * len(rows)


def schedule(first: IntArray, stop: IntArray, value: FloatArray, apart: int) -> IntArray:
    """Weighted interval scheduling: the candidates (chosen,) of largest total `value`, in order of time.

    Candidate k occupies rows `first[k]` to `stop[k]` - 1; between two chosen ones lie at least `apart` rows.
    """
    order = np.argsort(stop, kind="stable")
    before = np.searchsorted(stop[order], first[order] - apart, side="right")
    return order[_schedule(before, value[order])[::-1]]


@njit(cache=True, error_model="numpy")
def _schedule(before: IntArray, value: FloatArray) -> IntArray:
    """`schedule` of candidates in order, `before` (candidate,) each of which so many may be chosen, too; the last
    first."""
    n = len(before)
    best = np.zeros(n + 1)
    for k in range(n):
        best[k + 1] = max(best[k], value[k] + best[before[k]])
    out = np.empty(n, np.int64)
    count, k = 0, n
    while k > 0:
        if best[k] > best[k - 1]:
            out[count] = k - 1
            count += 1
            k = before[k - 1]
        else:
            k -= 1
    return out[:count]


# one stretch ---------------------------------------------------------------------------------------------------------
@njit(cache=True, fastmath=True, error_model="numpy")
def _gains(
    m: PulseModel, score: FloatArray, backwards: FloatArray, first: int, most: int, pulse: FloatArray, out: FloatArray
) -> int:
    """Gains s' w - w' A w / 2 of the stretches of 1 to `most` rows from row `first` on into `out`, and how many were
    computed: none where s' w alone never exceeds the penalty, and none behind the last row where it does.

    `backwards`: the information from its last lag to lag 0, so that the inner loop runs forwards through memory.
    """
    held, linear, last = m.demand[first - 1], 0.0, 0
    for k in range(most):
        pulse[k] = held - m.demand[first + k]
        linear += pulse[k] * score[first + k]
        pulse[k] *= m.cover[first + k]
        out[k] = linear
        if linear > m.penalty:
            last = k + 1
    quadratic = 0.0
    zero = len(backwards) - 1
    for k in range(last):
        w = pulse[k]
        if w != 0.0:
            beside = 0.0
            for i in range(k):
                beside += pulse[i] * backwards[zero - k + i]
            quadratic += w * (w * backwards[zero] + 2.0 * beside)
        out[k] -= 0.5 * quadratic
    return last


@njit(cache=True, error_model="numpy")
def _longer(x: NDArray[Any]) -> NDArray[Any]:
    """`x` (element,) and as many free places. A loop: what numba has for it takes seconds to compile."""
    out = np.empty(2 * len(x), x.dtype)
    for k in range(len(x)):
        out[k] = x[k]
    return out


@njit(cache=True, error_model="numpy")
def candidates(m: PulseModel, score: FloatArray, begin: int, end: int) -> tuple[IntArray, IntArray, FloatArray]:
    """Stretches within rows `begin` to `end` - 1 that gain more than the penalty: `first`, `stop`, `gain` (candidate,).

    A stretch begins in a row whose command differs from the one before: a loss that changes nothing is not seen. Of
    those that begin in one row, a longer one counts only if it gains more than each shorter one.
    """
    out, pulse, backwards = np.empty(m.longest), np.empty(m.longest), m.information[::-1].copy()
    count = 0
    first, stop, gain = np.empty(256, np.int64), np.empty(256, np.int64), np.empty(256)
    for i in range(max(begin, 1), end):
        most = min(m.longest, end - i, m.free[i] - m.tail - i)
        if most <= 0 or m.demand[i] == m.demand[i - 1]:
            continue
        best = m.penalty
        for k in range(_gains(m, score, backwards, i, most, pulse, out)):
            if out[k] > best:
                best = out[k]
                if count == len(gain):
                    first, stop, gain = _longer(first), _longer(stop), _longer(gain)
                first[count], stop[count], gain[count] = i, i + k + 1, best
                count += 1
    return first[:count], stop[:count], gain[:count]


@njit(cache=True, error_model="numpy")
def _best_within(m: PulseModel, score: FloatArray, begin: int, end: int) -> tuple[int, int]:
    """First and last row + 1 of the candidate of largest gain within rows `begin` to `end` - 1; (0, 0) without any."""
    first, stop, gain = candidates(m, score, begin, end)
    if len(gain) == 0:
        return 0, 0
    k = int(np.argmax(gain))
    return first[k], stop[k]


@njit(cache=True, error_model="numpy")
def _put(m: PulseModel, score: FloatArray, i: int, j: int, sign: float) -> None:
    """`score` beside the stretch from row `i` to `j` - 1 (`sign` -1: without it), in place."""
    rows = np.arange(i, j)
    take_out(score, m.information, m.cover, rows, m.demand[i - 1] - m.demand[rows], sign)


@njit(cache=True, error_model="numpy")
def _conditional_modes(
    m: PulseModel, score: FloatArray, begin: IntArray, end: IntArray, count: int, sweeps: int
) -> int:
    """Move, resize, drop and add stretches `begin`, `end` while G gains, in place; the number of stretches left.

    At least one row lies between two. `score` (row,) is overwritten by that beside all stretches.
    """
    n = len(score)
    for k in range(count):
        _put(m, score, begin[k], end[k], 1.0)
    for _ in range(sweeps):
        changed = False
        k = 0
        while k < count:
            i, j = begin[k], end[k]
            _put(m, score, i, j, -1.0)
            low = end[k - 1] + 1 if k > 0 else 1
            high = begin[k + 1] - 1 if k + 1 < count else n
            a, b = _best_within(m, score, low, high)
            if b > 0:
                _put(m, score, a, b, 1.0)
                begin[k], end[k] = a, b
                changed = changed or a != i or b != j
                k += 1
            else:
                count -= 1
                for later in range(k, count):
                    begin[later], end[later] = begin[later + 1], end[later + 1]
                changed = True
        k = 0
        while k <= count:  # what the others leave
            low = end[k - 1] + 1 if k > 0 else 1
            high = begin[k] - 1 if k < count else n
            a, b = _best_within(m, score, low, high)
            if b > 0:
                _put(m, score, a, b, 1.0)
                for later in range(count, k, -1):
                    begin[later], end[later] = begin[later - 1], end[later - 1]
                begin[k], end[k] = a, b
                count += 1
                changed = True
            else:
                k += 1
        if not changed:
            break
    return count
