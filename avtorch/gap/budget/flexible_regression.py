"""What commands, speed and time predict of the residuals, by a regression without physics.

It has two uses: what it leaves over is the noise that `noise_whitening` fits, and what it predicts of blocks that were
held out is reproducible and not explained.
"""

from __future__ import annotations

import numpy as np

from avtorch.arrays import FloatArray
from avtorch.gap.budget.analysis_record import AnalysisRecord
from avtorch.gap.budget.held_out_evidence import Evidence, agreement
from avtorch.gap.budget.robust_fit import Fit, M, RobustFit
from avtorch.gap.likelihood.basis import lowpass

_RIDGES = (1e-4, 1e-3, 1e-2, 1e-1, 1.0, 10.0)  # of the columns' own sums of squares


def columns(fit: Fit[M]) -> FloatArray:
    """Smooth functions of the rollout's acceleration, commands, speed and time: (column, channel, row).

    A force shows in both channels, a fault of the accelerometer in its own alone.
    """
    record = fit.model.record
    rollout = fit.model.simulate(fit.z)[0]
    time = (record.time - record.time.min()) / (np.ptp(record.time) + 1e-9) - 0.5
    speed = (record.speed - record.speed[record.counts].mean()) / max(float(record.speed[record.counts].std()), 0.1)
    forces = np.concatenate(
        [
            _forces(record, rollout[s.rows], speed[s.rows], time[s.rows], record.command[s.rows])
            for s in record.stretches
        ],
        -1,
    )
    if len(record.channels) == 1:
        return forces[:, None]
    faults = np.stack([np.zeros_like(forces), forces], 1)[:12]
    return np.concatenate([np.stack([forces, forces], 1), faults])


def _forces(record: AnalysisRecord, a: FloatArray, speed: FloatArray, t: FloatArray, u: FloatArray) -> FloatArray:
    dt = record.dt
    v = lowpass(speed, 0.5, dt)
    jerk = np.gradient(a) / dt
    snap = np.gradient(lowpass(jerk, 0.1, dt)) / dt
    braking = np.minimum(a, 0.0)
    play = lowpass(np.tanh(np.gradient(u) / dt / 0.1), 0.3, dt)
    one = np.ones_like(a)
    plain = [
        one,
        a,
        jerk,
        snap,
        v,
        v**2,
        a * v,
        jerk * v,
        braking,
        np.gradient(braking) / dt,
        a * t,
        a * t**2,
    ]
    rest = [a * v**2, a * t**3, np.tanh(a / 0.1), np.tanh(a / 0.3), np.tanh(jerk / 0.3), play]
    return np.array([*plain, *rest, lowpass(u, 1.0, dt), lowpass(u, 3.0, dt), t, t**2], dtype=float)


def left_over(fitting: RobustFit, fit: Fit[M]) -> FloatArray:
    """Residuals (channel, row) less the regression, fitted to all blocks."""
    residuals, shapes = fit.residuals, columns(fit)
    X, y, scale = _white(fitting, shapes, residuals)
    coefficients = np.linalg.solve(X @ X.T + 1e-4 * X.shape[1] * np.eye(len(X)), X @ y) / scale
    return residuals - (coefficients @ shapes.reshape(len(shapes), -1)).reshape(residuals.shape)


def predicted_residuals(fitting: RobustFit, fit: Fit, residuals: FloatArray) -> FloatArray:
    """What the regression makes of `residuals` (channel, row), each block by a fit to the other folds.

    The ridge is what predicts held-out blocks best; where these do not agree on it more surely than chance, nothing.
    """
    whitening, record = fitting.whitening, fit.model.record
    shapes = columns(fit)
    X, y, scale = _white(fitting, shapes, residuals)
    fold = whitening.spread(fitting.fold.astype(float))
    fold = np.tile(fold, len(record.channels))
    row_fold = fitting.fold_of_row
    before = fitting.nats(whitening(residuals))
    best, after = np.zeros_like(residuals), before
    for ridge in _RIDGES:
        out = np.zeros_like(residuals)
        for k in range(int(fitting.fold.max()) + 1):
            kept = fold != k
            gram = X[:, kept] @ X[:, kept].T
            coefficients = np.linalg.solve(gram + ridge * kept.sum() * np.eye(len(X)), X[:, kept] @ y[kept]) / scale
            rows = row_fold == k
            out[:, rows] = np.tensordot(coefficients, shapes[..., rows], 1)
        cost = fitting.nats(whitening(residuals - out))
        if cost.sum() < after.sum():
            best, after = out, cost
    white, found = whitening(residuals), whitening(best)
    errors, freedom = agreement(whitening.by_block(white * found), whitening.by_block(found**2))
    evidence = Evidence(float((before - after).sum()), errors, freedom)
    return best if evidence.strength(len(_RIDGES)) > 0 else np.zeros_like(residuals)


def _white(fitting: RobustFit, shapes: FloatArray, residuals: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """White columns (column, channel · counted) of size one, white residuals, and the columns' sizes."""
    X = fitting.whitening(shapes).reshape(len(shapes), -1)
    scale = np.sqrt((X**2).mean(1)) + 1e-12
    return X / scale[:, None], fitting.whitening(residuals).ravel(), scale
