"""Lost command messages: the car holds the last command received, and the log does not show which were lost.

The lost messages are unknown, so the likelihood of a loss fraction `p` sums over the possible histories. A message at
row `i` is lost with probability `p`; the command in force is then still that of the last message received, `h`, and all
later errors of the rollout receive `(h - u[i])` times the whitened image of a unit pulse in one row. A path of a bank
is one such history: its `h`, and the effect of its losses so far on later errors. At each row every path is weighted by
the whitened errors of that row alone, then split in two (received, lost). Of the paths whose predictions differ least,
the lighter is merged into the heavier, by mean.

Each error is thus explained once, by the losses that predict it best, and not by several rows at the same time. Despite
the merging, the bank predicts each row by a proper density given the earlier rows. Under noise alone the likelihood
ratio therefore has mean 1, and evidence above `x` nats occurs in at most exp(-x) of all drives.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np

from avtorch.arrays import BoolArray, FloatArray, IntArray
from avtorch.gap.likelihood.whitening_filter import WhiteningFilter
from avtorch.gap.search.outliers import onset_of
from avtorch.gap.search.row_response import RowResponse

_CENTRE, _SD = float(np.log(0.08 / 0.92)), 1.0  # of the prior of the fraction's logit
_FIRST = np.array([-3.0, -1.0, 1.0, 3.0])  # fractions tried first, in sds of the prior
_ROUNDS = 4
_PATHS = 6
_FAINT = 1e-3  # what all jumps within a chunk of rows may tell together [nats] and still be skipped


@dataclass(frozen=True, eq=False)
class LostMessages:
    """Lost messages: `evidence` [nats] over none, `fraction` and the sd of its logit; `onset` row or None."""

    evidence: float
    fraction: float
    sd: float
    onset: int | None


def lost_messages(
    white: WhiteningFilter, errors: FloatArray, command: FloatArray, T_L: float, K_L: float
) -> LostMessages:
    """Evidence for lost messages, and the fraction lost.

    Args: `errors` (channel, counted, 1) of a rollout with `T_L` [s] and `K_L`, at the log's own rate; `command`
    (counted,) [m/s²], one message per row. A run of losses does not extend into the next stretch.
    """
    record = white.record
    bank = LossHistories.of(white, white(errors)[..., 0], command, T_L, K_L)
    if not len(bank.place):
        return LostMessages(-2.0, 0.0, 1.0, None)  # the command is constant

    def tried(z: FloatArray) -> tuple[FloatArray, list[tuple[int, float]]]:
        rows = bank.ratios(_fraction(z))
        onsets = [onset_of(row, record.dt) for row in rows]
        # onset at the start or at any row, equally likely
        return rows.sum(1) + np.logaddexp(0.0, [more for _, more in onsets]) - np.log(2.0), onsets

    z = _FIRST
    value, onsets = tried(z)
    mass = value - 0.5 * z**2
    evidence = float(np.logaddexp.reduce(mass) - np.logaddexp.reduce(-0.5 * z**2))
    best = int(np.clip(mass.argmax(), 1, len(z) - 2))
    found = _posterior(z[best - 1 : best + 2], value[best - 1 : best + 2])
    if evidence > 0:
        for _ in range(_ROUNDS):
            z = found.mean + 1.5 * found.sd * np.array([-1.0, 0.0, 1.0])
            value, onsets = tried(z)
            before, found = found, _posterior(z, value)
            evidence = found.evidence
            if np.abs(found.mean - z[1]) < found.sd and 0.7 < found.sd / before.sd < 1.5:
                break
    onset, more = onsets[int((value - 0.5 * z**2).argmax())]
    fraction = float(_fraction(np.array(found.mean)))
    return LostMessages(evidence, fraction, found.sd * _SD, onset if more > 1 else None)


@dataclass(frozen=True, eq=False)
class LossRatios:
    """Log likelihood ratios, losses over none, `rows` (fraction, counted) at fractions of prior coordinates `z`."""

    z: FloatArray
    rows: FloatArray

    @classmethod
    def of(cls, white: WhiteningFilter, errors: FloatArray, command: FloatArray, T_L: float, K_L: float) -> LossRatios:
        """Arguments as in `lost_messages`."""
        bank = LossHistories.of(white, white(errors)[..., 0], command, T_L, K_L)
        z = np.linspace(-3.0, 3.0, 13)
        if not len(bank.place):
            return cls(z, np.zeros((len(z), white.record.rows)))
        return cls(z, bank.ratios(_fraction(z)))

    def fitted_to(self, fits: BoolArray) -> FloatArray:
        """The ratio (counted,) of each row at the fraction that is best in the rows `fits`."""
        return self.rows[int((self.rows[:, fits].sum(1) - 0.5 * self.z**2).argmax())]


def _fraction(z: FloatArray) -> FloatArray:
    return 1 / (1 + np.exp(-_CENTRE - _SD * z))


@dataclass(frozen=True)
class _Posterior:
    """Posterior of the fraction's prior coordinate: mean and sd, and the log evidence [nats]."""

    mean: float
    sd: float
    evidence: float


def _posterior(z: FloatArray, value: FloatArray) -> _Posterior:
    """Posterior from log likelihoods `value` at three `z`: interpolated as if known numbers of messages had been lost
    and received, or by a parabola where that does not fit."""

    def counted(z: FloatArray) -> FloatArray:
        p = _fraction(z)
        return np.stack([np.log(p), np.log1p(-p), np.ones_like(p)], -1)

    terms = counted
    weights = np.linalg.solve(terms(z), value)
    if weights[:2].min() < 0:
        terms = partial(np.vander, N=3)
        weights = np.linalg.solve(terms(z), value)
    fine = np.linspace(2 * z[0] - z[1], 2 * z[2] - z[1], 801)
    line = terms(fine) @ weights - 0.5 * fine**2 - 0.5 * np.log(2 * np.pi)
    mass = np.exp(line - line.max())
    mean = float(mass @ fine / mass.sum())
    sd = float(np.sqrt(mass @ (fine - mean) ** 2 / mass.sum()))
    return _Posterior(mean, max(sd, 1e-3), float(line.max() + np.log(mass.sum() * (fine[1] - fine[0]))))


@dataclass(frozen=True, eq=False)
class LossHistories:
    """Paths over chunks of rows, all chunks and all fractions at once.

    `move`, `push`, `see`: state-space model of a path's losses, x' = move x + push (h - u), with whitened errors see x;
    in coordinates in which the square of x is that of all later errors. `place` (chunk, step): rows, of which the first
    `warm` only initialise the paths; `valid` where within the stretch. `error` (channel, counted).
    """

    move: FloatArray
    push: FloatArray
    see: FloatArray
    place: IntArray
    valid: BoolArray
    warm: int
    error: FloatArray
    command: FloatArray

    @classmethod
    def of(
        cls, white: WhiteningFilter, error: FloatArray, command: FloatArray, T_L: float, K_L: float
    ) -> LossHistories:
        record, response = white.record, RowResponse.of(white, T_L, K_L)
        place, valid = [], []
        jumps = np.diff(command, prepend=command[0]) ** 2
        jumps[record.starts] = 0.0
        for rows, inside in response.chunks(record):
            if jumps[rows[inside]].sum() * response.energy > _FAINT:
                place.append(rows)
                valid.append(inside)
        move, push, see, warm = response.move, response.push, response.see, response.warm
        rows = np.array(place, np.int64).reshape(-1, warm + response.size)
        return cls(move, push, see, rows, np.array(valid, bool).reshape(rows.shape), warm, error, command)

    def ratios(self, fractions: FloatArray) -> FloatArray:
        """Log likelihood ratio of each row given the earlier ones, losses over none: (fraction, counted)."""
        count, steps = self.place.shape
        order, total = len(self.push), len(fractions) * count
        p = np.repeat(fractions, count)[:, None]
        u = np.tile(self.command[self.place], (len(fractions), 1))
        e = np.tile(np.where(self.valid, self.error[:, self.place], 0.0), (1, len(fractions), 1))
        # paths (chunk, path, states and held command); held commands are scaled by their possible later effect
        weight = np.zeros((total, _PATHS))
        weight[:, 0] = 1.0
        path = np.zeros((total, _PATHS, order + 1))
        path[..., order] = u[:, :1]
        scale = np.ones((total, 1, order + 1))
        scale[:, 0, order] = np.sqrt(p[:, 0] * (self.push**2).sum())
        out = np.zeros((total, steps))
        drift = np.zeros((order + 1, order + 1))
        drift[:order, :order] = self.move.T
        drift[order, order] = 1.0
        for t in range(steps):
            predicted = path[..., :order] @ self.see.T
            gain = (predicted @ e[:, :, t].T[..., None])[..., 0] - 0.5 * (predicted**2).sum(-1)
            with np.errstate(divide="ignore"):
                gain += np.log(weight)
            top = gain.max(1, keepdims=True)
            weight = np.exp(gain - top)
            mass = weight.sum(1, keepdims=True)
            weight /= mass
            out[:, t] = (top + np.log(mass))[:, 0]
            moved = path @ drift
            lost, now = moved.copy(), u[:, t, None]
            moved[..., order] = now
            lost[..., :order] += (lost[..., order] - now)[..., None] * self.push
            weight, path = _merged(
                np.concatenate([weight * (1 - p), weight * p], 1), np.concatenate([moved, lost], 1), scale
            )
        rows = np.zeros((len(fractions), len(self.command)))
        own = self.valid[:, self.warm :]
        out = out.reshape(len(fractions), count, steps)[:, :, self.warm :]
        rows[:, self.place[:, self.warm :][own]] = out[:, own]
        return rows


def _merged(weight: FloatArray, path: FloatArray, scale: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Half as many paths: those whose merging changes least are merged into the nearest one kept."""
    count = weight.shape[1]
    keep = count // 2
    order = np.argsort(-weight, 1)
    weight = np.take_along_axis(weight, order, 1)
    path = np.take_along_axis(path, order[..., None], 1)
    at = path * scale
    square = (at**2).sum(-1)
    apart = at @ at.mT
    apart *= -2
    apart += square[:, None]
    apart += square[:, :, None]  # (chunk, lighter, heavier)
    loss = (apart + _HEAVIER).min(2)
    loss *= weight
    loss[:, 0] = np.inf
    kept = np.argpartition(-loss, keep - 1, 1)[:, :keep]
    apart[:, np.arange(count), np.arange(count)] = -np.inf
    nearest = apart[np.arange(len(kept))[:, None], kept].argmin(1)
    joins = (nearest[:, None] == np.arange(keep)[:, None]) * weight[:, None]
    total = joins.sum(2)
    return total, (joins @ path) / np.maximum(total, 1e-300)[..., None]


_HEAVIER = np.triu(np.full((2 * _PATHS, 2 * _PATHS), 1e30))
