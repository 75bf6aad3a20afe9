"""What commands, speed, place and time predict of the residuals, by a regression without physics.

It has two uses: what it leaves over is the noise that `noise_whitening` fits, and what it predicts of blocks that were
held out is reproducible and not explained.

It looks back only. In a closed loop a command answers the noise of the moment, so columns that hold the command of the
next row predict noise: the fit took 0.5 to 1 Hz from it and left up to twenty times as much below 0.2 Hz, in which
slow forces were hidden and gusts seen.
"""

from __future__ import annotations

import numpy as np
from scipy.interpolate import BSpline

from avtorch.arrays import FloatArray
from avtorch.gap.budget.analysis_record import AnalysisRecord, later
from avtorch.gap.budget.held_out_evidence import Evidence, agreement
from avtorch.gap.budget.robust_fit import Fit, M, RobustFit
from avtorch.gap.likelihood.basis import lowpass

_BACK_S = 0.1  # that columns are late, two rows at least: derivatives and resampled rows hold the next ones
_DEGREE = 3
_FEWEST = 8  # knots along the way; fewer follow what changes slowly with time just as well
_RIDGES = (1e-4, 1e-3, 1e-2, 1e-1, 1.0, 10.0)  # of the columns' own sums of squares


def columns(fit: Fit[M]) -> FloatArray:
    """Smooth functions of the past acceleration of the rollout, commands, speed and time: (column, channel, row).

    A force shows in both channels, a fault of the accelerometer in its own alone.
    """
    record = fit.model.record
    rollout = fit.model.simulate(fit.z)[0]
    time = (record.time - record.time.min()) / (np.ptp(record.time) + 1e-9) - 0.5
    speed = (record.speed - record.speed[record.counts].mean()) / max(float(record.speed[record.counts].std()), 0.1)
    back = max(2, round(_BACK_S / record.dt))
    forces = np.concatenate(
        [
            later(_forces(record, rollout[s.rows], speed[s.rows], time[s.rows], record.command[s.rows]), back)
            for s in record.stretches
        ],
        -1,
    )
    if len(record.channels) == 1:
        return forces[:, None]
    faults = np.stack([np.zeros_like(forces), forces], 1)[:12]
    return np.concatenate([np.stack([forces, forces], 1), faults])


def _places(fit: Fit[M]) -> FloatArray:
    """Cubic splines of the place (column, channel, row), with knots as far apart as what is driven in a block."""
    record = fit.model.record
    positions = [s.drive.position for s in record.stretches]
    if not record.has_speed or any(x is None for x in positions):
        return np.empty((0, len(record.channels), record.rows))
    place = np.concatenate([np.asarray(x, float) for x in positions if x is not None])
    way, knot = float(np.ptp(place)), record.knot_m
    if way < _FEWEST * knot:
        return np.empty((0, len(record.channels), record.rows))
    inner = np.linspace(place.min(), place.max(), max(round(way / knot), 2) + 1)
    knots = np.concatenate([[inner[0]] * _DEGREE, inner, [inner[-1]] * _DEGREE])
    # their sum is the constant, which is a column already
    along = BSpline.design_matrix(place, knots, _DEGREE).toarray().T[1:]
    return np.stack([along] * len(record.channels), 1)


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


def left_over(fitting: RobustFit, fit: Fit[M], *, places: bool = False) -> FloatArray:
    """Residuals (channel, row) less the regression, fitted to all blocks; `places`: on the place, too.

    Without the place a road is slow noise, and the noise hides it. But where each place is passed once, its columns
    follow whatever wanders, and the noise seems smaller than it is, so `baseline_noise` asks for a road first.
    """
    residuals, shapes = fit.residuals, columns(fit)
    if places:
        shapes = np.concatenate([shapes, _places(fit)])
    X, y, scale = _white(fitting, shapes, residuals)
    coefficients = np.linalg.solve(X @ X.T + 1e-4 * X.shape[1] * np.eye(len(X)), X @ y) / scale
    return residuals - (coefficients @ shapes.reshape(len(shapes), -1)).reshape(residuals.shape)


def has_places(fit: Fit[M]) -> bool:
    """Whether the drive is long enough that the place tells more than the time."""
    return len(_places(fit)) > 0


def predicted_residuals(fitting: RobustFit, fit: Fit, residuals: FloatArray) -> FloatArray:
    """What the regression makes of `residuals` (channel, row), each block by a fit to the other folds.

    The ridge is what predicts held-out blocks best; where these do not agree on it more surely than chance, nothing.
    """
    shapes, places = columns(fit), _places(fit)
    found = _predicted(fitting, shapes, residuals)
    if not len(places) or not _predicted(fitting, places, residuals).any():
        return found
    # many places may hide what commands and speed predict by themselves
    both = _predicted(fitting, np.concatenate([shapes, places]), residuals)
    costs = [float(fitting.nats(fitting.whitening(residuals - x)).sum()) for x in (found, both)]
    return both if costs[1] < costs[0] else found


def _predicted(fitting: RobustFit, shapes: FloatArray, residuals: FloatArray) -> FloatArray:
    whitening, channels = fitting.whitening, shapes.shape[1]
    X, y, scale = _white(fitting, shapes, residuals)
    fold = np.tile(whitening.spread(fitting.fold.astype(float)), channels)
    row_fold = fitting.fold_of_row
    before = fitting.nats(whitening(residuals))
    best, after = np.zeros_like(residuals), before
    own = [fold == k for k in range(int(fitting.fold.max()) + 1)]
    grams = np.array([X[:, rows] @ X[:, rows].T for rows in own])
    moments = np.array([X[:, rows] @ y[rows] for rows in own])
    for ridge in _RIDGES:
        out = np.zeros_like(residuals)
        for k in range(len(own)):
            gram = grams.sum(0) - grams[k] + ridge * (~own[k]).sum() * np.eye(len(X))
            coefficients = np.linalg.solve(gram, moments.sum(0) - moments[k]) / scale
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
