"""Drives as the engine sees them: rows of all usable stretches, and their lapped coefficients.

Each stretch is cut into half-overlapping frames of 4 to 10 s and transformed by the modified discrete cosine transform
(Princen and Bradley 1987; an orthonormal lapped transform): coefficients `(channel, frame, bin)` are real, nearly
independent for stationary noise, and local in time and frequency. A frame is a block of time, a band of bins a colour.
Channels are the acceleration [m/s²] and the differenced speed [m/s²]; both keep their noise, whatever its spectrum.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, NamedTuple, Self

import numpy as np
from numba import njit
from scipy.fft import dct
from scipy.ndimage import gaussian_filter1d

from avtorch.arrays import BoolArray, FloatArray, IntArray
from avtorch.errors import InputError
from avtorch.gap.engine.compiled_plant import GRID_S
from avtorch.gap.engine.priors import BAND_RATIO, CLAIM_HZ, FRAME_S, SLOW_HZ, WARM_S
from avtorch.io import Log
from avtorch.io.log import AccelKind, no_command

UNKNOWN_SPEED_MPS = 15.0
"""What effects read where no speed was measured [m/s]."""
_MOST_HZ = 100.0  # rows of faster logs are averaged: nothing above half of it is a car's
_SMOOTH_S = 0.3  # the speed enters effects smoothed over it
_START_S = 0.6  # over which the first acceleration is averaged
_LEAST_COEFFICIENTS = 6  # of a band, in each channel
_FRAMES = 30  # of a drive, within the limits of their length


@dataclass(frozen=True, eq=False)
class Grid:
    """Steps of at most `GRID_S` on which the plant runs; all (grid,) but `accel0`, which counts at `starts`.

    `row`: the row whose command acts in a step.
    """

    time: FloatArray = field(repr=False)
    row: IntArray = field(repr=False)
    speed: FloatArray = field(repr=False)
    starts: BoolArray = field(repr=False)
    accel0: FloatArray = field(repr=False)


class BandResponse(NamedTuple):
    """What the transform makes of tones: `energy` (band, tone) [Hz] times a one-sided spectrum (tone,) is the mean
    square of a coefficient in each band below `SLOW_HZ`. `frequency` (tone,) [Hz]; integration is included."""

    frequency: FloatArray
    energy: FloatArray


def _tones(bin_hz: float) -> FloatArray:
    """Tones (tone,) [Hz] on which spectra are integrated, of bins so far apart.

    Even steps of 0.4 bins, as a bin's response has no structure finer than half of one; below, the spectra's own
    resolution, one in twelve.
    """
    step = 0.4 * bin_hz
    slow = np.exp(np.arange(math.log(5e-4), math.log(12 * step), math.log(13 / 12)))
    return np.concatenate([[0.0], slow, np.arange(slow[-1] + step, 1.5 * SLOW_HZ, step)])


def one_pole(time_constant: float, step: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """y_k = keep y_{k-1} + new x_k + old x_{k-1}: one pole, exact where x is straight between rows `step` [s] apart."""
    keep = np.exp(-step / time_constant)
    held = time_constant / step * (1 - keep)
    return keep, 1 - held, held - keep


@dataclass(eq=False)
class DriveData:
    """Rows of one or several logs of one car, and the coefficients `measured` (channel, frame, bin).

    `time` (row,) [s] runs on through all logs; `stamp` (row,) [s] is the own clock of log number `log` (row,), `source`
    (row,) the row there, `group` of which are averaged into one; `count` (row,) numbers rows of the log as its recorder
    wrote them, lost ones too. `command` (row,) [m/s²]; `accel` [m/s²] and
    `speed` [m/s] (row,) or None; `smooth_speed` (row,) [m/s] and `position` (row,) [m], which effects read.
    `starts` (row,): first rows of stretches, between `bounds` (stretch + 1,). `frames`: first row and number of
    frames of each stretch that has any; `frame_time` (frame,) [s] their middles. `band_edges` (band + 1,) [bins];
    `band_of_bin` (bin,); `band_size` (band,) coefficients per channel.
    `hold`: rows for which the recorder holds a speed, from the count `hold_phase` on. `align_s` [s]: delay of the
    accelerometer in the coefficients, by which both channels are in phase. `raw_accel`: as read, where outliers
    were replaced. `reference_speed` [m/s]: at which slopes with speed are neutral.
    """

    time: FloatArray
    stamp: FloatArray
    log: IntArray
    source: IntArray
    count: IntArray
    command: FloatArray
    accel: FloatArray | None
    speed: FloatArray | None
    smooth_speed: FloatArray
    position: FloatArray
    bounds: IntArray
    dt: float
    group: int = 1
    accel_kind: AccelKind = "kinematic"
    hold: int = 1
    hold_phase: int = 0
    align_s: float = 0.0
    raw_accel: FloatArray | None = None
    reference_speed: float = 0.0
    # of the transform, see `_frame`
    warm_rows: int = 0
    frame_rows: int = 0
    frames: list[tuple[int, int]] = field(default_factory=list)
    used: BoolArray = field(default_factory=lambda: np.zeros(0, bool))
    frame_time: FloatArray = field(default_factory=lambda: np.zeros(0))
    frequency: FloatArray = field(default_factory=lambda: np.zeros(0))
    band_edges: IntArray = field(default_factory=lambda: np.zeros(0, np.int64))
    measured: FloatArray = field(default_factory=lambda: np.zeros((0, 0, 0)))

    @property
    def claim_hz(self) -> float:
        """Frequency [Hz] below which an explanation has to gain: `CLAIM_HZ`, at low rates half of what rows resolve."""
        return min(CLAIM_HZ, 0.25 / self.dt)

    # reading -------------------------------------------------------------------------------------------------------
    @classmethod
    def of(cls, logs: Log | Sequence[Log]) -> Self:
        """The data of one or several logs of one car.

        Raises `InputError` for logs without `accel_cmd`, with different channels, rates or kinds of `accel`, or where
        no stretch of driving is long enough for two frames.
        """
        each = [logs] if isinstance(logs, Log) else list(logs)
        _same_kind(each)
        rate = min(log.rate_hz for log in each)
        group = max(1, int(1.02 * rate / _MOST_HZ))
        columns: dict[str, list[Any]] = {
            name: [] for name in ("time", "stamp", "log", "source", "count", "command", "accel", "speed")
        }
        lengths, begin, longest = [0], 0.0, 0.0
        for number, log in enumerate(each):
            assert log.accel_cmd is not None
            steps = np.rint(np.diff(log.elapsed) * log.rate_hz)  # one by one: stamps need not be even
            count = np.append(0, np.cumsum(np.maximum(steps, 1)).astype(np.int64))
            for part in _stretches(log):
                rows = (part.stop - part.start) // group
                cut = slice(part.start, part.start + rows * group)
                seconds = rows * group / log.rate_hz
                longest = max(longest, seconds)
                if seconds < WARM_S + 2 * FRAME_S[0]:
                    continue

                def mean(x: FloatArray | None, cut: slice = cut, rows: int = rows) -> FloatArray:
                    return np.zeros(0) if x is None else x[cut].reshape(rows, group).mean(1)

                columns["time"].append(begin + mean(log.elapsed))
                columns["stamp"].append(mean(log.time))
                columns["log"].append(np.full(rows, number))
                columns["source"].append(np.arange(cut.start, cut.stop, group))
                columns["count"].append(count[cut.start : cut.stop : group] // group)
                columns["command"].append(mean(log.accel_cmd))
                columns["accel"].append(mean(log.accel))
                columns["speed"].append(mean(log.speed))
                lengths.append(rows)
            begin += float(log.elapsed[-1]) + 60.0  # no delay reaches from one log into another
        if len(lengths) == 1:
            names = ", ".join(dict.fromkeys(log.name for log in each))
            raise InputError(
                f"{names}: {longest:.1f} s of driving in one stretch (moving, engaged), needs "
                f"{WARM_S + 2 * FRAME_S[0]:.0f} s or more"
            )
        whole: dict[str, Any] = {name: np.concatenate(parts) for name, parts in columns.items()}
        whole |= {name: None for name in ("accel", "speed") if getattr(each[0], name) is None}
        bounds = np.cumsum(lengths)
        dt = float(np.median(np.diff(whole["time"])))
        data = cls(
            **whole,
            smooth_speed=_smooth_speed(whole["time"], whole["accel"], whole["speed"], bounds, dt),
            position=np.zeros(len(whole["time"])),
            bounds=bounds,
            dt=dt,
            group=group,
            accel_kind=each[0].accel_kind,
        )
        # the mean while moving, as the effects' files have it
        data.reference_speed = max(float(data.smooth_speed.mean()), 1e-3)
        data.position = data._positions()
        data.hold, data.hold_phase = data._find_hold()
        data._frame()
        return data

    # shape ---------------------------------------------------------------------------------------------------------
    @property
    def channels(self) -> tuple[str, ...]:
        return tuple(name for name in ("accel", "speed") if getattr(self, name) is not None)

    @property
    def channel_count(self) -> int:
        return len(self.channels)

    @property
    def frame_count(self) -> int:
        return len(self.frame_time)

    @property
    def bin_count(self) -> int:
        return int(self.band_edges[-1])

    @property
    def band_count(self) -> int:
        return len(self.band_edges) - 1

    @property
    def band_of_bin(self) -> IntArray:
        return np.repeat(np.arange(self.band_count), np.diff(self.band_edges))

    @property
    def band_size(self) -> IntArray:
        return np.diff(self.band_edges) * self.frame_count

    @property
    def hop_s(self) -> float:
        return self.frame_rows * self.dt

    @property
    def starts(self) -> BoolArray:
        out = np.zeros(len(self.time), bool)
        out[self.bounds[:-1]] = True
        return out

    @cached_property
    def window(self) -> FloatArray:
        M = self.frame_rows
        return np.sin(np.pi * (np.arange(2 * M) + 0.5) / (2 * M))

    @cached_property
    def grid(self) -> Grid:
        steps = np.diff(self.time)
        last = np.zeros(len(self.time), bool)
        last[self.bounds[1:] - 1] = True
        parts = np.where(last, 1, (np.append(steps, 1.0) / GRID_S).astype(np.int64) + 1)
        row = np.repeat(np.arange(len(self.time)), parts)
        within = np.arange(len(row)) - np.repeat(np.cumsum(parts) - parts, parts)
        share = within / parts[row]
        later = np.minimum(row + 1, len(self.time) - 1)
        time = self.time[row] + share * (self.time[later] - self.time[row])
        speed = self.smooth_speed[row] + share * (self.smooth_speed[later] - self.smooth_speed[row])
        starts = self.starts[row] & (within == 0)
        accel0 = np.zeros(len(row))
        accel0[starts] = [self._first_accel(i) for i in self.bounds[:-1]]
        return Grid(time, row, speed, starts, accel0)

    # rows to coefficients and back -----------------------------------------------------------------------------------
    def transform(self, rows: Sequence[FloatArray]) -> FloatArray:
        """Coefficients (channel, frame, bin) of signals (row,), one a channel."""
        begins = np.concatenate([first + self.frame_rows * np.arange(count) for first, count in self.frames])[self.used]
        folded = np.empty((len(rows), len(begins), self.frame_rows))
        for x, out in zip(rows, folded, strict=True):
            _fold(np.ascontiguousarray(x), begins, self.window, out)
        return np.ascontiguousarray(_dct4(folded)[..., : self.bin_count])

    def adjoint(self, coefficients: FloatArray) -> FloatArray:
        """Rows (row,) whose inner product with a signal is that of `coefficients` (frame, bin) with its transform."""
        M, h, window = self.frame_rows, self.frame_rows // 2, self.window
        whole = np.zeros((len(self.used), M))
        whole[self.used, : self.bin_count] = coefficients
        y = _dct4(whole)
        out, done = np.zeros(len(self.time)), 0
        for first, count in self.frames:
            a, b = y[done : done + count, :h], y[done : done + count, h:]
            w = np.concatenate([b, -b[:, ::-1], -a[:, ::-1], -a], 1) * window
            for k in range(count):
                out[first + k * M : first + k * M + 2 * M] += w[k]
            done += count
        return out

    def below(self, fmax: float) -> DriveData:
        """The same drives, of which bands that begin below `fmax` [Hz] count."""
        edges = self.band_edges[: max(int(np.searchsorted(self.frequency[self.band_edges[:-1]], fmax)), 1) + 1]
        bins = int(edges[-1])
        measured = np.ascontiguousarray(self.measured[:, :, :bins])
        return replace(self, band_edges=edges, frequency=self.frequency[:bins], measured=measured)

    def only(self, frames: BoolArray) -> DriveData:
        """The same drives, of which only these `frames` (frame,) count."""
        used = self.used.copy()
        used[self.used] = frames
        measured = self.measured[:, frames]
        return replace(self, used=used, frame_time=self.frame_time[frames], measured=measured)

    def part(self, rows: BoolArray) -> DriveData:
        """The stretches at `rows` (row,), which are successive; slopes stay neutral at the speed of all drives."""
        first, last = int(np.argmax(rows)), len(rows) - int(np.argmax(rows[::-1]))
        frame_rows = np.concatenate([np.full(n, first <= i < last) for i, n in self.frames])
        by_row = ("time", "stamp", "log", "source", "count", "command", "accel", "speed", "smooth_speed", "position")
        cut = {name: getattr(self, name) for name in (*by_row, "raw_accel")}
        return replace(
            self,
            **{name: None if x is None else x[first:last] for name, x in cut.items()},
            bounds=self.bounds[(self.bounds >= first) & (self.bounds <= last)] - first,
            frames=[(i - first, n) for i, n in self.frames if first <= i < last],
            used=self.used[frame_rows],
            frame_time=self.frame_time[frame_rows[self.used]],
            measured=self.measured[:, frame_rows[self.used]],
        )

    def with_accel(self, accel: FloatArray) -> DriveData:
        """The same drives with other readings of the accelerometer (row,); those as read stay in `raw_accel`."""
        other = replace(self, raw_accel=self.accel if self.raw_accel is None else self.raw_accel, accel=accel)
        other.measured = other._measured()
        return other

    def with_align(self, align_s: float) -> DriveData:
        """The same drives with the accelerometer, measured and simulated alike, this much later [s]."""
        other = replace(self, align_s=align_s)
        other.measured = other._measured()
        return other

    # what the recorder does, measured and simulated alike ------------------------------------------------------------
    def channel_rows(self, accel: FloatArray | None, speed: FloatArray | None) -> list[FloatArray]:
        """Readings (row,) as the channels that are compared: an aligned acceleration, a differenced speed."""
        out = [] if accel is None else [self.aligned(accel)]
        return out if speed is None else [*out, self.speed_difference(speed)]

    def aligned(self, accel: FloatArray) -> FloatArray:
        """As late as the speed: what shakes the car is then in phase in both."""
        return _read(np.ascontiguousarray(accel), *self.aligned_at) if self.align_s else accel

    @cached_property
    def aligned_at(self) -> tuple[IntArray, FloatArray]:
        """Where `aligned` reads: rows (row,), and shares of the way to the next."""
        return _places(np.interp(self.time - self.align_s, self.time, np.arange(len(self.time))))

    def speed_difference(self, speed: FloatArray) -> FloatArray:
        """Central difference [m/s²], in phase with the acceleration; at the ends of stretches that of the next row."""
        rate, middle = self.difference_tables
        return ((speed[2:] - speed[:-2]) * rate)[middle]

    @cached_property
    def difference_tables(self) -> tuple[FloatArray, IntArray]:
        """Of two rows' difference: its factor (row - 2,) [1/s], and which of them each row (row,) shows."""
        middle = np.arange(len(self.time))
        middle[self.bounds[1:] - 1] -= 1
        middle[self.bounds[:-1]] += 1
        return 1.0 / np.maximum(self.time[2:] - self.time[:-2], 0.3 * self.dt), middle - 1

    def held(self, x: FloatArray) -> FloatArray:
        """As a recorder shows it that refreshes every `hold` rows, whether or not that row was lost."""
        return x if self.hold == 1 else _read(np.ascontiguousarray(x), *self.held_at)

    @cached_property
    def held_at(self) -> tuple[IntArray, FloatArray]:
        """Where `held` reads: the row (row,) of the last refresh, between two rows where that one was lost."""
        count = self.count + self.log * (2 * self.count.max() + self.hold)
        since = (self.count - self.hold_phase) % self.hold
        first = np.repeat(self.bounds[:-1], np.diff(self.bounds))
        return _places(np.maximum(np.interp(count - since, count, np.arange(len(count))), first))

    def low_pass(self, x: FloatArray, time_constant: float) -> FloatArray:
        """One pole of this time constant [s], at rest at the start of each stretch (see `one_pole`)."""
        if time_constant < 1e-4:
            return x
        gaps, steps = self.gaps
        return filtered(np.ascontiguousarray(x), self.bounds, gaps, *one_pole(time_constant, steps))

    @cached_property
    def gaps(self) -> tuple[IntArray, FloatArray]:
        """Rows (row,) that were lost in front of each, and the steps [s] for none, one, and so on."""
        lost = np.maximum(np.diff(self.count, prepend=self.count[:1]), 1) - 1
        lost[self.bounds[:-1]] = 0
        return lost, self.dt * np.arange(1.0, lost.max() + 2)

    # inside ----------------------------------------------------------------------------------------------------------
    @cached_property
    def band_response(self) -> BandResponse:
        """The response of bands below `SLOW_HZ` to tones of any phase.

        A coefficient is sum_n h_n x_n; of a stationary x its mean square is int S(f) |H(f)|² df, H the Fourier
        transform of its row h of the transform. Its real and imaginary parts are the coefficients of a cosine and a
        sine.
        """
        edges = self.band_edges
        bands = min(int(np.searchsorted(self.frequency[edges[:-1]], SLOW_HZ)), self.band_count)
        M = self.frame_rows
        h = M // 2
        tones = _tones(float(self.frequency[1] - self.frequency[0]))
        phase = 2 * np.pi * tones[:, None] * np.arange(2 * M) * self.dt
        w = np.concatenate([np.cos(phase), np.sin(phase)]) * self.window
        folded = np.concatenate([-w[:, M + h - 1 : M - 1 : -1] - w[:, M + h :], w[:, :h] - w[:, M - 1 : h - 1 : -1]], 1)
        squares = np.asarray(dct(folded, type=4, norm="ortho", axis=1))[:, : edges[bands]] ** 2
        each = squares[: len(tones)] + squares[len(tones) :]
        energy = np.add.reduceat(each, edges[:bands], axis=1) / np.diff(edges[: bands + 1])
        steps = np.diff(tones, prepend=tones[0], append=tones[-1])
        return BandResponse(tones, energy.T * 0.5 * (steps[1:] + steps[:-1]))

    def _measured(self) -> FloatArray:
        return self.transform(self.channel_rows(self.accel, self.speed))

    def _frame(self) -> None:
        """Cut stretches into frames and bins into bands."""
        lengths = np.diff(self.bounds)
        warm = int(WARM_S / self.dt)
        hop = float(np.clip(lengths.sum() * self.dt / _FRAMES, *FRAME_S))
        rest = lengths - warm
        M = min(int(hop / self.dt), int(rest.max()) // 2)
        if len(rest) == 1:  # frames that fill the one stretch
            M = int(rest[0]) // (max(int(rest[0]) // M - 1, 1) + 1)
        M = _even(M)
        self.warm_rows, self.frame_rows, self.frames = warm, M, []
        for begin, length in zip(self.bounds[:-1].tolist(), rest.tolist(), strict=True):
            count = length // M - 1
            if count >= 1:
                self.frames.append((begin + warm + (length - (count + 1) * M) // 2, count))
        self.frame_time = np.concatenate([self.time[i + M * (1 + np.arange(count))] for i, count in self.frames])
        self.used = np.ones(len(self.frame_time), bool)
        self.frequency = np.asarray((np.arange(M) + 0.5) / (2 * M * self.dt), np.float64)
        least = -(-_LEAST_COEFFICIENTS // len(self.frame_time))  # bins: a covariance of few coefficients is singular
        edges = [0, least, 2 * least, 3 * least]
        while edges[-1] < M:
            edges.append(max(edges[-1] + least, int(edges[-1] * BAND_RATIO)))
        edges[-1] = M
        if edges[-1] - edges[-2] < 0.4 * (edges[-2] - edges[-3]):
            del edges[-2]
        self.band_edges = np.array(edges)
        self.measured = self._measured()

    def _positions(self) -> FloatArray:
        out, offset = np.zeros(len(self.time)), 0.0
        for i, j in zip(self.bounds[:-1], self.bounds[1:], strict=True):
            steps = self.smooth_speed[i : j - 1] * np.diff(self.time[i:j])
            out[i:j] = offset + np.concatenate([[0.0], np.cumsum(steps)])
            offset = float(out[j - 1])
        return out

    def _find_hold(self) -> tuple[int, int]:
        """A speed that changes in every k-th row, but for repeated rows: k and the count of such a row."""
        if self.speed is None:
            return 1, 0
        changed = (np.diff(self.speed) != 0) & (np.diff(self.count) == 1)
        for k in range(10, 1, -1):
            counts = np.bincount(self.count[1:][changed] % k, minlength=k)
            # a repeated row at a renewal shows it a row late; without a hold a k-th of the changes is here
            if counts.max() > 0.9 * counts.sum() and counts.sum() > 30:
                return k, int(counts.argmax())
        return 1, 0

    def _first_accel(self, row: int) -> float:
        w = max(3, int(_START_S / self.dt))
        if self.accel is not None:
            return float(self.accel[row : row + w].mean())
        v, t = self.smooth_speed, self.time
        return float((v[row + w] - v[row]) / (t[row + w] - t[row]))


def _same_kind(logs: Sequence[Log]) -> None:
    """Raises `InputError` for logs without `accel_cmd`, or with different channels, rates or kinds of `accel`."""
    if not logs:
        raise InputError("logs: none given, needs one or more")
    names = ", ".join(dict.fromkeys(log.name for log in logs))
    for log in logs:
        if log.accel_cmd is None:
            raise no_command(log, ", which the diagnosis needs")
    if len({(log.accel is not None, log.speed is not None) for log in logs}) > 1:
        raise InputError(f"logs: {names} have different channels; needs accel, speed or both in all")
    if len({log.accel_kind for log in logs}) > 1:
        raise InputError(f"logs: {names} have different kinds of accel; needs one in all")
    rates = [log.rate_hz for log in logs]
    if max(rates) > 1.02 * min(rates):
        given = ", ".join(f"{log.name} {log.rate_hz:.3g} Hz" for log in logs)
        raise InputError(f"logs: found rates of {given}; needs one rate in all, or one diagnosis each")


def _stretches(log: Log) -> list[slice]:
    """Rows in which the car moves and obeys the command, without a gap. The speed is smoothed: its noise is no stop."""
    out = []
    for part in log.engaged_segments():
        moves = log.moving[part]
        if log.speed is not None:
            smooth = gaussian_filter1d(log.speed[part], _SMOOTH_S * log.rate_hz, mode="nearest")
            moves = smooth > log.standstill_mps
        change = np.flatnonzero(np.diff(moves.astype(int), prepend=0, append=0)).tolist()
        out += [slice(part.start + i, part.start + j) for i, j in zip(change[::2], change[1::2], strict=True)]
    return out


def _smooth_speed(
    time: FloatArray, accel: FloatArray | None, speed: FloatArray | None, bounds: IntArray, dt: float
) -> FloatArray:
    """The speed beside the integral of the acceleration, smoothed: corners stay sharp."""
    if speed is None:
        return np.full(len(time), UNKNOWN_SPEED_MPS)
    out = np.empty_like(speed)
    for i, j in itertools.pairwise(bounds):
        c = np.zeros(j - i)
        if accel is not None:
            c[1:] = np.cumsum(0.5 * (accel[i + 1 : j] + accel[i : j - 1]) * np.diff(time[i:j]))
        out[i:j] = gaussian_filter1d(speed[i:j] - c, _SMOOTH_S / dt) + c
    return out


def _places(at: FloatArray) -> tuple[IntArray, FloatArray]:
    """Rows at or before places between rows, (row,), and shares of the way to the next."""
    below = np.clip(at.astype(np.int64), 0, len(at) - 2)
    return below, at - below


def _dct4(x: FloatArray) -> FloatArray:
    """The orthonormal cosine transform of type IV along the last axis."""
    return np.asarray(dct(x, type=4, norm="ortho", axis=-1))


@njit(cache=True, error_model="numpy")
def _fold(x: FloatArray, begins: IntArray, window: FloatArray, out: FloatArray) -> None:
    """Frames of `x` (row,) that begin at rows `begins` (frame,), windowed and folded to half their length: (frame, M),
    whose cosine transform is the lapped one."""
    M = out.shape[1]
    h = M // 2
    for f in range(len(begins)):
        w = x[begins[f] : begins[f] + 2 * M]
        for k in range(h):
            out[f, k] = -window[M + h - 1 - k] * w[M + h - 1 - k] - window[M + h + k] * w[M + h + k]
            out[f, h + k] = window[k] * w[k] - window[M - 1 - k] * w[M - 1 - k]


@njit(cache=True, error_model="numpy")
def filtered(
    x: FloatArray, bounds: IntArray, gaps: IntArray, keep: FloatArray, new: FloatArray, old: FloatArray
) -> FloatArray:
    """`x` (row,) behind a pole whose coefficients (gap,) depend on the rows lost in front of each row (`gaps`)."""
    out = np.empty(len(x))
    for s in range(len(bounds) - 1):
        out[bounds[s]] = x[bounds[s]]
        for i in range(bounds[s] + 1, bounds[s + 1]):
            k = gaps[i]
            out[i] = keep[k] * out[i - 1] + new[k] * x[i] + old[k] * x[i - 1]
    return out


@njit(cache=True, error_model="numpy")
def _read(x: FloatArray, below: IntArray, share: FloatArray) -> FloatArray:
    out = np.empty(len(below))
    for i in range(len(below)):
        k = below[i]
        out[i] = x[k] + share[i] * (x[k + 1] - x[k])
    return out


def _even(rows: int) -> int:
    """The largest even number of rows up to `rows` that the transform is fast at."""
    for k in range(rows, rows // 2, -1):
        rest = k
        for f in (2, 3, 5):
            while rest % f == 0:
                rest //= f
        if k % 2 == 0 and rest == 1:
            return k
    return rows - rows % 2
