"""What a further effect promises to gain from a set, to first order.

The promise of an effect is the projection of the residual on its response, in units of the noise, after the parameters
that are in have taken what they can: a search orders by it what it fits. An effect that sets in during the drive is
priced at every time at once, by the residual's adjoint and by frames; then its best times are computed.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from avtorch.arrays import FloatArray
from avtorch.gap.engine.coordinates import INDEX, EngineEffect
from avtorch.gap.engine.drive_data import DriveData
from avtorch.gap.engine.evidence import onset_nats
from avtorch.gap.engine.gauss_newton import linearised, normal_prior, whitened_jacobian
from avtorch.gap.engine.hypothesis import Hypothesis
from avtorch.gap.engine.likelihood import least_noise, log_likelihood, whiten

_MARGIN_S = 8.0  # no onset this near to an end of the drive
_TRIED_ONSETS = 3  # of an effect from one start
_SLOPES = {
    "dead_time": 0.02,
    "sensor_lag": 0.02,
    "speed_lag": 0.02,
    "square_period": 0.002,
}  # where a recorder hides a finite step


class Promise(NamedTuple):
    """What an effect may gain to first order [nats], from which start, and from which time on."""

    nats: float
    effect: str
    start: tuple[float, ...]
    onset: float | None


class Projection:
    """The residual and any response less what the free parameters take, in units of the noise.

    Priors are rows of their own: a recorder stretched to its limits to hide an effect pulls back.
    """

    def __init__(self, h: Hypothesis) -> None:
        names = h.free
        slopes, precision, pull = linearised(h, names)
        W = whitened_jacobian(h, slopes)
        self.rows = len(W)
        A = np.hstack([W, np.diag(np.sqrt(precision))])
        r = np.concatenate([whiten(h.data, h.covariance, h.residual), pull / np.sqrt(np.maximum(precision, 1e-30))])
        size = np.linalg.norm(A, axis=1)
        self._basis = np.linalg.qr((A[size > 1e-9] / size[size > 1e-9, None]).T)[0]
        self._basis_by_frame = _by_frame(h.data, self._basis[: -self.rows])
        self.residual = r - self._basis @ (self._basis.T @ r)

        self._data, self._spread = h.data, None
        if h.force_spread is not None:
            inverse = np.linalg.inv(np.linalg.cholesky(h.covariance))
            self._spread = inverse @ h.force_spread @ np.swapaxes(inverse, 1, 2)
        self._start = self._nats(self.residual)

    def __call__(self, whitened: FloatArray) -> FloatArray:
        x = np.concatenate([whitened, np.zeros(self.rows)])
        return x - self._basis @ (self._basis.T @ x)

    def sizes_from(self, whitened: FloatArray) -> FloatArray:
        """Square (frame,) of the projected response that begins with each frame: whole, less its part in the span."""
        x = _by_frame(self._data, whitened)
        spanned = (x[:, None] @ self._basis_by_frame)[:, 0]
        energy, spanned = (x * x).sum(1)[::-1].cumsum(), spanned[::-1].cumsum(0)
        return np.maximum(energy - (spanned**2).sum(1), 0.0)[::-1]

    def nats_from(self, whitened: FloatArray, sizes: FloatArray) -> FloatArray:
        """What the best multiple of a response gains (frame,) that begins with each frame: under the noise as it is,
        or under that of what is left, where a step has raised the noise. `sizes`: its `sizes_from`."""
        data = self._data
        shape = data.channel_count, data.frame_count, data.bin_count
        x, r = (np.moveaxis(a.reshape(shape), 0, -1) for a in (whitened, self.residual[: -self.rows]))

        def since(a: FloatArray, b: FloatArray) -> FloatArray:
            products = np.add.reduceat(a[..., :, None] * b[..., None, :], data.band_edges[:-1], axis=1)
            return products[::-1].cumsum(0)[::-1] / data.band_size[:, None, None]

        shared, energy, whole = since(r, x), since(x, x), since(r, r)[0]
        gain, raw = (np.einsum("b,fbii->f", data.band_size, a) for a in (shared, energy))
        both, whole = shared + np.swapaxes(shared, -1, -2), whole + least_noise(whole)

        def nats(multiple: FloatArray) -> FloatArray:
            m = multiple[:, None, None, None]
            return -0.5 * np.linalg.slogdet(whole - m * both + m * m * energy)[1] @ data.band_size

        start = nats(np.zeros(1))[0]
        left = np.maximum(nats(gain / (raw + 1)), nats(gain / np.maximum(raw, 1e-9))) - start
        return np.maximum(left, 0.5 * gain**2 / (sizes + 1))

    def nats(self, free: FloatArray, e: EngineEffect, start: Sequence[float]) -> float:
        """What the best multiple of a projected response gains, its size penalised by the effect's prior; the noise's
        covariance is that of what is left, as everywhere: a band's own excess does not hide what explains it."""
        gain, size = float(free @ self.residual), float(free @ free)
        sds = [normal_prior(c.name, 0.0)[1] for c in e.coordinates if c.faint]
        precision = sum((x / sd) ** 2 for x, sd in zip(start, sds, strict=False))
        shares = gain / (size + 1), gain / max(size, 1e-9)
        return max(self._nats(self.residual - x * free) - 0.5 * precision * x * x for x in shares) - self._start

    def _nats(self, x: FloatArray) -> float:
        data = self._data
        shape = data.channel_count, data.frame_count, data.bin_count
        nats = log_likelihood(data, x[: -self.rows].reshape(shape), self._spread)[0]
        return nats - 0.5 * float(x[-self.rows :] @ x[-self.rows :])


def _by_frame(data: DriveData, whitened: FloatArray) -> FloatArray:
    """Coefficients of all channels (channel x frame x bin, ...) by frame: (frame, channel x bin, ...)."""
    by_frame = whitened.reshape(data.channel_count, data.frame_count, data.bin_count, *whitened.shape[1:])
    by_frame = np.moveaxis(by_frame, 1, 0)
    return np.ascontiguousarray(by_frame.reshape(data.frame_count, -1, *whitened.shape[1:]))


def promises(h: Hypothesis, candidates: Sequence[EngineEffect]) -> list[Promise]:
    """Gains of further effects to first order, the best first: at most two a effect that act all the time, and one
    that sets in later."""
    projection = Projection(h)
    adjoint = _adjoint_rows(h, projection)
    response = h.rows()
    out: list[Promise] = []
    for e in candidates:
        always: list[Promise] = []
        later: list[Promise] = []
        for start in e.starts or limit_starts(h):
            for kept in (False, True) if e.name == "dead_time" else (False,):
                p = h.values.copy()
                for c, x in zip(e.coordinates, start, strict=True):
                    p[INDEX[c.name]] = x
                if kept:  # a lag hides most of a delay
                    p[0] = max(p[0] - 0.8 * start[0], min(p[0], 0.06))
                whole, since = _at(h, projection, adjoint, response, e, start, p)
                always += whole + ([] if kept else _by_slope(_beside(h, e, start), projection, e, start))
                later += since
        always.sort(key=lambda x: -x.nats)
        later.sort(key=lambda x: -x.nats)
        if always and later and later[0].nats < always[0].nats - 1:
            later = []
        out += always[:2] + later[:1]
    return sorted(out, key=lambda x: -x.nats)


def _beside(h: Hypothesis, e: EngineEffect, start: tuple[float, ...]) -> Hypothesis:
    """Whose plant has the effect: the simulator runs one only where a hypothesis has it."""
    return h if e.kind is None and h.baseline is None else h.with_effect(e.name, start)


def _at(
    h: Hypothesis,
    projection: Projection,
    adjoint: Sequence[FloatArray],
    response: Sequence[FloatArray],
    e: EngineEffect,
    start: tuple[float, ...],
    values: FloatArray,
) -> tuple[list[Promise], list[Promise]]:
    """Promises of an effect at `values` (parameter,): over the whole drive, and from some time on."""
    beside = _beside(h, e, start)
    rows = beside.rows(values)
    whitened = whiten(h.data, h.covariance, h.data.transform(rows) - h.predicted)
    whole = [] if e.onset == "must" else _whole(h, projection, e, start, whitened)
    if e.onset == "never":
        return whole, []
    steps = np.sum([z * (a - b) for z, a, b in zip(adjoint, rows, response, strict=True)], axis=0)
    return whole, _onsets(beside, projection, e, start, values, whitened, steps)


def later_than_the_start(h: Hypothesis, e: EngineEffect, at: tuple[float, ...]) -> Promise | None:
    """The best promise of an effect that sets in during the drive, at values (coordinate,); None where it promises more
    from the start."""
    projection = Projection(h)
    whole, later = _at(h, projection, _adjoint_rows(h, projection), h.rows(), e, at, h.with_effect(e.name, at).values)
    best = max(later, key=lambda x: x.nats, default=None)
    return best if best is not None and best.nats > max((x.nats for x in whole), default=0.0) else None


def _whole(
    h: Hypothesis, projection: Projection, e: EngineEffect, start: tuple[float, ...], whitened: FloatArray
) -> list[Promise]:
    free = projection(whitened)
    size, gain = float(free @ free), float(free @ projection.residual)
    if size <= 1e-6 * float(whitened @ whitened) or (gain <= 0 and e.one_sided):
        return []
    turned = start if gain > 0 or e.name == "driveline_oscillation" else tuple(-x for x in start)
    return [Promise(projection.nats(free, e, start), e.name, turned, None)]


def _by_slope(h: Hypothesis, projection: Projection, e: EngineEffect, start: tuple[float, ...]) -> list[Promise]:
    """By the slope at zero, where the recorder hides a finite step."""
    name = e.coordinates[0].name
    if name not in _SLOPES or e.onset == "must":
        return []
    p = h.values.copy()
    p[INDEX[name]] = _SLOPES[name]
    change = (h.response(p) - h.predicted) * (start[0] / _SLOPES[name])
    free = projection(whiten(h.data, h.covariance, change))
    gain = float(free @ projection.residual)
    return [Promise(projection.nats(free, e, start), e.name, start, None)] if gain > 0 else []


def _onsets(
    h: Hypothesis,
    projection: Projection,
    e: EngineEffect,
    start: tuple[float, ...],
    values: FloatArray,
    whitened: FloatArray,
    steps: FloatArray,
) -> list[Promise]:
    """The best onsets, and those of effects that are in: what the effect gains from each frame on tells the frame, the
    residual's adjoint the row in it; then the response is computed."""
    data = h.data
    if data.frame_count < 2:
        return []
    gains = np.cumsum(steps[::-1])[::-1]
    sizes = projection.sizes_from(whitened)
    size = np.interp(data.time, data.frame_time - 0.5 * data.hop_s, sizes)
    size = np.maximum(size, 0.15 * sizes.max())
    inside = (data.time > data.time[0] + _MARGIN_S) & (data.time < data.time[-1] - _MARGIN_S)
    priced = np.where(inside & ((gains > 0) | (not e.one_sided)), 0.5 * gains**2 / (size + 1), 0.0)
    tried = [(onset, 0.0) for onset in sorted(set(h.onsets.values()))]
    frames = projection.nats_from(whitened, sizes)
    for _ in range(_TRIED_ONSETS):
        frame = int(frames.argmax())
        if frames[frame] <= 0:
            break
        before = data.frame_time[frame - 1] if frame else data.time[0]
        near = inside & (data.time > before - data.hop_s) & (data.time < data.frame_time[frame] + data.hop_s)
        rows = {int(np.where(near, priced, 0.0).argmax()), *np.flatnonzero(near & data.starts)}
        tried += [(float(data.time[row]), onset_nats(data)) for row in sorted(rows) if near[row]]
        frames[np.abs(data.frame_time - data.frame_time[frame]) < 1.5 * data.hop_s] = 0
    out = []
    for onset, price in tried:
        acts = h.onset_vector()
        for c in e.coordinates:
            acts[INDEX[c.name]] = onset
        free = projection(whiten(data, h.covariance, h.response(values, acts) - h.predicted))
        n, gain = float(free @ free), float(free @ projection.residual)
        if n > 1e-9 and (gain > 0 or not e.one_sided):
            alone = sum(bool(c.faint) for c in e.coordinates) == 1  # the first one is the size, the others its shape
            scaled = (start[0] * float(np.clip(gain / n, -4, 4)), *start[1:]) if alone else start
            out.append(Promise(projection.nats(free, e, start) - price, e.name, scaled, onset))
    return out


def _adjoint_rows(h: Hypothesis, projection: Projection) -> list[FloatArray]:
    """The projected residual on the rows of each channel: its inner product with a response is that of the whitened
    coefficients."""
    data = h.data
    r = projection.residual[: -projection.rows].reshape(data.channel_count, data.frame_count, data.bin_count)
    inverse = np.linalg.inv(np.linalg.cholesky(h.covariance))[data.band_of_bin]
    out = []
    for i in range(data.channel_count):
        out.append(data.adjoint(np.sum([inverse[:, c, i] * r[c] for c in range(i, data.channel_count)], axis=0)))
    return out


def limit_starts(h: Hypothesis) -> list[tuple[float, float]]:
    """Starts of both limits, from the largest commands (inverse, [s²/m])."""
    x = h["K_L"] * h.data.command
    high, low = max(float(np.percentile(x, 99.9)), 0.05), min(float(np.percentile(x, 0.1)), -0.05)
    pairs = ((0.7, 1.3), (0.4, 1.3), (1.3, 0.7), (1.3, 0.4), (0.7, 0.7))
    return [(1 / (high * f), 1 / (-low * g)) for f, g in pairs]
