"""Causes that no response predicts, identified by their effect on the noise: each returns -log L with it, given a
fit."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from avtorch.arrays import FloatArray
from avtorch.gap import RoadGrade
from benchmarks.blindtest.rivals.maximum_likelihood import Fitter, MaximumLikelihoodFit

_ROAD_HZ = 3.0  # the effect of a road on a car is slower


def outliers(fitter: Fitter, fit: MaximumLikelihoodFit) -> float:
    """A few samples of the acceleration have a wider normal error: two more parameters, by expectation maximisation."""
    innovations = _innovations(fitter, fit)[0]
    square = (innovations / innovations.std()) ** 2
    share, wide, narrow = 0.01, 25.0, 0.9
    mixed = plain = -0.5 * float(square.sum())
    for _ in range(60):
        far = np.log(share) - 0.5 * np.log(wide) - 0.5 * square / wide
        near = np.log1p(-share) - 0.5 * np.log(narrow) - 0.5 * square / narrow
        both = np.logaddexp(far, near)
        mixed = float(both.sum())
        mine = np.exp(far - both)
        share = float(np.clip(mine.mean(), 1e-6, 0.2))
        wide = max(float((mine @ square) / max(mine.sum(), 1e-9)), 9.0)
        narrow = float(((1 - mine) @ square) / (1 - mine).sum())
    return fit.loss - max(mixed - plain, 0.0)


def command_hold(fitter: Fitter, fit: MaximumLikelihoodFit) -> float:
    """Innovations are larger where the command has just stepped: one more parameter."""
    innovations, rows = _innovations(fitter, fit)
    # the step before the row: the row's own command already depends on the row's noise
    push = fitter.drive.push[rows - 1]
    if push.max() <= 0:
        return fit.loss
    gains = [0.0]
    for more in np.geomspace(1e-3, 30.0, 25):
        spread = 1 + more * push / push.mean()
        size = np.mean(innovations**2 / spread) / np.mean(innovations**2)
        gains.append(-0.5 * float(np.log(size) * len(innovations) + np.log(spread).sum()))
    return fit.loss - max(gains)


def road_grade(fitter: Fitter, fit: MaximumLikelihoodFit) -> float | None:
    """A slope that is a smooth random function of position, as a mixed model: one more parameter, its size.

    The slope's coefficients are integrated out, T_L, K_L and the effects' parameters are adjusted to first order, and
    the noise is refitted. None where the drive is in pieces.
    """
    drive, spectrum = fitter.drive, fitter.spectrum
    only, *more = drive.drives
    if more:
        return None
    assert only.position is not None
    road = RoadGrade().prepared(only.time, only.speed, only.position)
    columns = road.columns(only.position).T.numpy()
    kept = int(np.searchsorted(spectrum.frequency, 2 * np.pi * _ROAD_HZ * drive.step))
    force = np.stack(
        [np.moveaxis(np.fft.rfft(drive.forced(one[None])[0], spectrum.length)[:, :kept], 0, -1) for one in columns]
    )
    residual, lag, sizes, gust_time = fit.transformed, fit.lag, fit.sizes, fit.gust_time
    best = fit.loss
    for _ in range(3):
        inverse = spectrum.inverse(lag, sizes, gust_time)
        low = inverse[:kept]
        weighed = 2 * np.einsum("kcd,pkd->pkc", low, force).conj().reshape(len(force), -1)
        flat = force.reshape(len(force), -1)
        slope = fit.slope[:, :kept].reshape(len(fit.slope), -1)
        matrix = (weighed @ flat.T).real
        cross = (weighed @ slope.T).real
        ahead = (weighed @ fit.transformed[:kept].ravel()).real
        weighed = 2 * np.einsum("kcd,pkd->pkc", inverse, fit.slope).conj().reshape(len(fit.slope), -1)
        own = (weighed @ fit.slope.reshape(len(fit.slope), -1).T).real + 1e-6 * np.eye(len(fit.slope))
        down = (weighed @ fit.transformed.ravel()).real
        back = np.linalg.solve(own, np.column_stack([cross.T, down]))
        values, vectors = np.linalg.eigh(matrix - cross @ back[:, :-1])
        values = np.maximum(values, 0.0)
        turned = vectors.T @ (ahead - cross @ back[:, -1])
        squares = np.geomspace(2e-3, 0.12, 30)[:, None] ** 2
        gains = 0.5 * (turned**2 * squares / (1 + squares * values) - np.log1p(squares * values)).sum(1)
        square = squares[int(np.argmax(gains)), 0]
        coefficients = vectors @ (turned * square / (1 + square * values))
        moved = back[:, -1] - back[:, :-1] @ coefficients
        residual = fit.transformed - np.tensordot(moved, fit.slope, 1)
        residual[:kept] -= np.tensordot(coefficients, force, 1)
        loss, sizes, gust_time = spectrum.fit_noise(spectrum.bands(residual), lag, sizes, gust_time is not None)
        price = 0.5 * (coefficients @ coefficients / square + np.log1p(square * values).sum())
        best = min(best, loss + price)
    return best


def _innovations(fitter: Fitter, fit: MaximumLikelihoodFit, order: int = 8) -> tuple[FloatArray, NDArray[np.intp]]:
    """Innovations of the first channel's residual given the rows before, and the numbers of their rows.

    By autoregression on all channels, because the controller acts on noise: a non-causal filter would take the command
    for the noise's cause.
    """
    valid = fitter.drive.valid
    residual = np.fft.irfft(fit.transformed, fitter.spectrum.length, 0)[: len(valid)]
    run = np.arange(len(valid)) - np.maximum.accumulate(np.where(valid, -1, np.arange(len(valid))))
    rows = np.flatnonzero(run > order)
    past = np.concatenate([residual[rows - i] for i in range(1, order + 1)], 1)
    weights = np.linalg.solve(past.T @ past + 1e-12 * np.eye(past.shape[1]), past.T @ residual[rows, 0])
    return residual[rows, 0] - past @ weights, rows
