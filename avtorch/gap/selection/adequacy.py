"""Adequacy of the most probable hypothesis: the goodness-of-fit test behind `unknown`.

A hypothesis may win by thousands of nats and still be wrong, when the cause is not in the table. Its whitened residuals
are therefore tested for any structure that a flexible model can find. Every test is a Bayes factor against white noise,
with regressors that were known before the row they predict: only commands, the rollout and the measured speed of
earlier rows. A controller that feeds noise back into later commands cannot create such structure: under the null the
expectation of a Bayes factor with predetermined regressors is 1, in open or closed loop, and the probability that its
logarithm exceeds `x` is below exp(-x) (Ville; Vovk and Wang 2021 on e-values). A Bayes factor penalises its own
coefficients, so no blocks are held out. The size of the coefficients is unknown, and a few values are averaged over.
The mean of Bayes factors has expectation 1 again, and this is how tests are combined here.

Fitting the noise to the same rows removes a little of the structure and never adds to it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
from scipy.ndimage import gaussian_filter1d

from avtorch.arrays import FloatArray
from avtorch.gap.likelihood.basis import linear_splines, lowpass
from avtorch.gap.likelihood.whitening_filter import WhiteningFilter
from avtorch.gap.selection.calibration import CALIBRATION

SCALES = CALIBRATION.remainder
"""Chosen before the weights of `unknown` were fitted, which are valid for these values only. The numbers below are
numerical safeguards against division by 0, blocks of a single row, and dominance of one extreme row or line."""

_DELAYS = SCALES.response_delays


@dataclass(frozen=True)
class Adequacy:
    """Log Bayes factors [nats] of structure in the residuals, 0 and below where there is none.

    - `flexible`: forces and sensor faults that are smooth functions of acceleration, command, speed and time, their
      products, hysteresis, or any smooth response to past jerk
    - `drift`: delay, lag, gain, force, or the sensors' gain and offset, differing from block to block
    - `line`: a force or reading that oscillates at one constant frequency
    - `memory`: an autoregression of the whitened residuals
    - `bursts`: a variance that depends on the driving or changes with time
    - `tails`: outlying single rows, by the fourth moment (an approximate gain, not a Bayes factor)
    """

    flexible: float
    drift: float
    line: float
    memory: float
    bursts: float
    tails: float

    def vector(self) -> FloatArray:
        return np.array([getattr(self, f.name) for f in fields(self)])

    @property
    def total(self) -> float:
        """All but `tails`, combined in one log Bayes factor."""
        return _mean((self.flexible, self.drift, self.line, self.memory, self.bursts))


def adequacy(
    white: WhiteningFilter,
    errors: FloatArray,
    rollout: FloatArray,
    *,
    explained: float = 0.0,
) -> Adequacy:
    """Adequacy from errors (channel, counted, group) of a hypothesis whose rollout is (channel, counted, group).

    `explained` [nats]: what the hypothesis's random effects explain although it remains in `errors` (lost messages:
    `found.losses.evidence`); it is subtracted from positive values, down to 0.
    """
    look = _Look(white, errors, rollout)
    return Adequacy(
        *(
            max(nats - explained, min(nats, 0.0))
            for nats in (look.flexible(), look.drift(), look.line(), look.memory(), look.bursts(), look.tails())
        )
    )


class _Look:
    """The whitened residuals and the regressors shared by all tests."""

    def __init__(self, white: WhiteningFilter, errors: FloatArray, rollout: FloatArray) -> None:
        record = white.record
        self.white, self.dt, self.channels, self.group = white, record.dt, record.channels, errors.shape[-1]
        self.each = white(errors)
        self.e = _summed(self.each)
        self.rows = self.e.shape[1]
        motion = rollout.mean(-1)
        # one row late: within a group of rows, commands already respond to the noise of the first rows
        self.a = _late(motion[0] if "accel" in self.channels else np.gradient(motion[-1]) / self.dt, 1)
        self.u = _late(record.command[record.source], 1)
        self.jerk = np.diff(self.a, prepend=self.a[0]) / self.dt
        self.v = np.zeros(self.rows)
        if "speed" in self.channels:
            self.v = lowpass(_late(record.measured[-1].mean(-1), 1), SCALES.speed_lag, self.dt)
        self.t = np.linspace(0.0, 1.0, self.rows)

    def _force(self, x: FloatArray) -> FloatArray:
        """Whitened image (column, channel * counted) of accelerations (column, counted) of the car itself."""
        return self._image(x, True, self.channels)

    def _reading(self, x: FloatArray, channel: str) -> FloatArray:
        """The same for a change in the reading of one channel only."""
        return self._image(x, False, (channel,))

    def _image(self, x: FloatArray, moves: bool, channels: Sequence[str]) -> FloatArray:
        out = np.empty((len(x), len(self.channels), self.rows))
        for i, column in enumerate(x):
            rows = np.zeros((len(self.channels), self.rows, self.group))
            for k, channel in enumerate(self.channels):
                if channel in channels:
                    rows[k] = column[:, None]
                    if moves and channel == "speed":
                        rows[k] = (np.cumsum(rows[k]) * self.dt / self.group).reshape(self.rows, self.group)
            out[i] = _summed(self.white(rows))
        return out.reshape(len(x), -1)

    def flexible(self) -> float:
        e, both = self.e.ravel(), len(self.channels) == 2
        a, v, t = self.a, self.v, self.t
        evidences = []
        apart = max(1, round(SCALES.response_spacing / self.dt))
        late = np.stack([_late(self.jerk, k * apart) for k in range(_DELAYS)])
        responses = [self._force(late)]
        if both:
            responses += [self._reading(late, "accel"), self._reading(late, "speed")]
        for response in responses:
            evidences.append(_mean([_evidence(_decaying(keep).T @ response, e) for keep in SCALES.response_decays]))
        counts = (SCALES.accel_knots, SCALES.speed_knots, SCALES.time_knots)
        of_a, of_v, of_t = (linear_splines(x, knots) for x, knots in zip((a, v, t), counts, strict=True))
        forces = [self._force(x) for x in (of_a, of_v, of_t, a * of_v, a * of_t)]
        commands = self._force(linear_splines(self.u, SCALES.command_knots))
        evidences += [_evidence(x, e) for x in (*forces, np.concatenate(forces), commands)]
        if both:
            evidences += [_evidence(self._reading(x, "accel"), e) for x in (of_a, of_v, of_t, a * of_v, a * of_t)]
            evidences += [_evidence(self._reading(x, "speed"), e) for x in (of_a, of_v)]
        push, brake = np.maximum(a, 0), np.minimum(a, 0)
        pushes, brakes = ([lowpass(x, s, self.dt) for s in SCALES.push_lags] for x in (push, brake))
        evidences.append(_evidence(self._force(np.stack([push, brake, *pushes, *brakes])), e))
        products = [x * y for x in (push, brake) for y in (*pushes, *brakes)]
        evidences.append(_evidence(self._force(np.stack(products)), e))
        turns, away = [np.tanh(self.jerk / s) for s in SCALES.jerk_turns], self.u - a
        play = [*turns, *(a * x for x in turns), np.abs(self.jerk), np.abs(away), away * np.abs(away)]
        play += [np.tanh(away / s) for s in SCALES.accel_turns]
        evidences.append(_evidence(self._force(np.stack(play)), e))
        return _mean(evidences)

    def drift(self) -> float:
        one = np.ones(self.rows)
        columns = [self._force(np.stack([self.jerk, self.u - self.a, self.a, one]))]
        if len(self.channels) == 2:
            columns.append(self._reading(np.stack([self.jerk, self.a, one]), "accel"))
            columns.append(self._reading(np.stack([self.a, self.v]), "speed"))
        evidences = []
        for x in np.concatenate(columns):
            square, cross = ((x * y).reshape(-1, self.rows).sum(0) for y in (x, self.e.ravel()))
            of_x = []
            for seconds in SCALES.drift_blocks:
                starts = np.arange(0, self.rows, max(2, round(seconds / self.dt)))
                part, match = np.add.reduceat(square, starts), np.add.reduceat(cross, starts)
                for size in SCALES.drift_sizes:
                    of_x.append(_scattered(part, match, size**2 / max(part.mean(), 1e-12)))
            evidences.append(_mean(of_x))
        return _mean(evidences)

    def line(self) -> float:
        record = self.white.record
        # rows at their own times, zeros between; padded for a fine grid of frequencies
        place = record.source - record.source[0]
        count, dt = len(self.e), self.dt / self.group
        grid = np.zeros((count, int(place[-1]) + 1, self.group))
        grid[:, place] = self.each
        grid = grid.reshape(count, -1)
        span = grid.shape[1]
        f = np.fft.rfftfreq(2 * span, dt)
        use = (f > SCALES.line_from) & (f < SCALES.line_to / self.dt)
        spectrum, f = np.fft.rfft(grid, n=2 * span, axis=-1)[:, use], f[use]
        length = min(span, 2048 * self.group)
        through = []
        for i in range(count):
            unit = np.zeros((count, length))
            unit[i, 0] = 1.0
            own = np.fft.rfft(self.white.response(unit))
            at = np.fft.rfftfreq(length, dt)
            through.append(np.stack([np.interp(f, at, y.real) + 1j * np.interp(f, at, y.imag) for y in own]))
        as_speed = 1 / (2j * np.pi * f)
        answers = [through[0] if "accel" in self.channels else through[0] * as_speed]
        if count == 2:
            answers.append(through[0] + through[1] * as_speed)
        evidences = []
        for answer in answers:
            weight = np.maximum((np.abs(answer) ** 2).sum(0), 1e-15)
            power = np.abs((answer.conj() * spectrum).sum(0)) ** 2 / weight / (self.rows * self.group)
            # relative to the local level of the spectrum, so that a broad hump does not count as lines
            power /= np.maximum(gaussian_filter1d(np.minimum(power, 6.0), 60), 1.0)
            evidences += [_mean(power * s / (1 + s) - np.log1p(s)) for s in SCALES.line_sizes]
        return _mean(evidences)

    def memory(self) -> float:
        order = SCALES.memory_order
        late = np.concatenate([[_late(x, k) for k in range(1, order + 1)] for x in self.e])
        columns = np.zeros((len(self.e), len(late), *self.e.shape))
        for i in range(len(self.e)):
            columns[i, :, i] = late
        return _evidence(columns.reshape(-1, self.e.size), self.e.ravel())

    def bursts(self) -> float:
        square = np.minimum(self.e**2 / self.e.var(-1, keepdims=True), 9.0)
        square = (square - square.mean(-1, keepdims=True)) / square.std(-1, keepdims=True)
        a, brisk = np.abs(self.a), lowpass(np.abs(self.jerk), SCALES.burst_lag, self.dt)
        evidences = []
        for x in (a, brisk, np.abs(self.u - self.a), self.v, self.t, a * self.v):
            if x.std() > 1e-9:
                each = [_evidence(((x - x.mean()) / x.std())[None], y) for y in square]
                evidences.append(_mean([*each, sum(each)]))
        local = []
        for seconds in SCALES.burst_blocks:
            starts = np.arange(0, self.rows, max(4, round(seconds / self.dt)))
            sums = np.add.reduceat(square, starts, axis=-1)
            sizes = np.diff(np.append(starts, self.rows)).astype(np.float64)
            for size in SCALES.burst_sizes:
                local.append(sum(_scattered(sizes, y, size**2 / sizes[0]) for y in sums))
        return _mean([*evidences, _mean(local)])

    def tails(self) -> float:
        z = np.clip(np.abs(self.e / self.e.std(-1, keepdims=True)), 0, 8)
        excess = (z**4).mean(-1) - 3
        return float(np.maximum(self.rows * excess**2 / 48 * np.sign(excess), 0).sum())


def _summed(e: FloatArray) -> FloatArray:
    """Whitened rows (..., counted, group) summed over groups and scaled to unit variance, (..., counted)."""
    return e.sum(-1) / np.sqrt(e.shape[-1])


def _mean(nats: Sequence[float] | FloatArray) -> float:
    """Log of the mean of Bayes factors, given by their logarithms."""
    return float(np.logaddexp.reduce(np.asarray(nats, float)) - np.log(len(nats)))


def _evidence(columns: FloatArray, e: FloatArray) -> float:
    """Log Bayes factor of e (row,) = coefficients (column,) of one unknown size @ columns (column, row) + white."""
    gram = columns @ columns.T
    typical = np.trace(gram) / max(len(columns), 1)
    if not typical > 1e-12:
        return 0.0
    values, vectors = np.linalg.eigh(gram / typical)
    values, match = np.maximum(values, 0.0), (vectors.T @ (columns @ e)) ** 2 / typical
    wide = [s * s for s in SCALES.sizes]
    return _mean([float(0.5 * (match * s / (1 + s * values) - np.log1p(s * values)).sum()) for s in wide])


def _scattered(square: FloatArray, match: FloatArray, variance: float) -> float:
    """Log Bayes factor of one column with independent coefficients of this variance in every block."""
    return float(0.5 * (match**2 * variance / (1 + variance * square) - np.log1p(variance * square)).sum())


def _late(x: FloatArray, rows: int) -> FloatArray:
    rows = min(rows, len(x))
    return np.concatenate([np.full(rows, x[0]), x[: len(x) - rows]])


def _decaying(keep: float) -> FloatArray:
    """Root of the stable-spline prior of impulse responses: smooth, and decaying by the factor `keep` per delay.

    Pillonetto and De Nicolao (2010), first-order kernel.
    """
    k = np.arange(float(_DELAYS))
    return np.asarray(np.linalg.cholesky(keep ** np.maximum(k[:, None], k) + 1e-9 * np.eye(_DELAYS)), np.float64)
