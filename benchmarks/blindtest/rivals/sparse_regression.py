"""Sparse identification of nonlinear dynamics (Brunton et al. 2016) by PySINDy: which term belongs in the equations?

da/dt is regressed on the command, on its response and on one effect's terms at a time, at about 20 Hz, by sequentially
thresholded least squares; so is the difference of dv/dt and the measured acceleration. The effect whose terms gain most
on held-out blocks is named, `none` where nothing gains. The slopes come from smoothing, as the method prescribes.
Smoothing is not causal: where a controller feeds noise back, it appears as a delay.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator
from importlib import import_module
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d
from scipy.signal import lfilter

from avtorch.arrays import BoolArray, FloatArray
from avtorch.errors import InputError
from avtorch.io import Log
from benchmarks.blindtest.reply import reply, softmax

_RATE_HZ = 20.0
_BLOCKS = 10
_SMOOTH_S = 0.1


def pysindy() -> ModuleType:
    """The package. Raises `InputError` that names the extra where it is missing."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            package = import_module("pysindy")
    except ImportError:
        raise InputError("sparse_regression: needs PySINDy, pip install 'avtorch[bench]'") from None
    return package


def sparse_regression(log: Log) -> dict[str, Any]:
    """Probabilities are in proportion to the exponential of the held-out gain [nats] less its parameters' price."""
    package = pysindy()
    every = max(1, round(log.rate_hz / _RATE_HZ))
    step = every / log.rate_hz
    if log.accel_cmd is None or log.rows < 10 * every * _BLOCKS:
        raise InputError(f"{log.name}: found {log.rows} rows, needs {10 * every * _BLOCKS} and accel_cmd")
    u, a, v = (None if x is None else _thin(x, every) for x in (log.accel_cmd, log.accel, log.speed))
    assert u is not None
    moving = _thin(log.usable.astype(float), every) == 1
    wide = _SMOOTH_S / step
    lag = _best_lag(u, a, v, moving, step)
    response = lagged(u, lag, step)
    # the slope of the acceleration is more informative about the actuator; without it only the speed's is left
    if a is not None:
        target = {"motion": gaussian_filter1d(a, wide, order=1) / step}
        base = {"motion": [u, response], "difference": []}
        if v is not None:
            target["difference"] = gaussian_filter1d(v, wide, order=1) / step - gaussian_filter1d(a, wide)
    else:
        assert v is not None
        target, base = {"motion": gaussian_filter1d(v, wide, order=1) / step}, {"motion": [response]}
    # the columns are smoothed too, or the smoothing of the slopes would be taken for a second pole
    base = {name: [gaussian_filter1d(x, wide) for x in columns] for name, columns in base.items()}
    block = np.arange(len(u)) * _BLOCKS // len(u)
    plain = {name: _held_out(package, target[name], base[name], block, moving, step) for name in target}
    found: dict[str, float] = {"none": 0.0}
    speed = None if v is None else gaussian_filter1d(v, wide)
    for name, equation, columns in terms(u, response, speed, step, (a is not None) + (v is not None)):
        columns = [gaussian_filter1d(x, wide) for x in columns]
        errors = _held_out(package, target[equation], [*base[equation], *columns], block, moving, step)
        worth = _worth(plain[equation])
        ratio = float(np.mean(plain[equation] ** 2) / np.mean(errors**2))
        found[name] = 0.5 * worth * math.log(ratio) - 0.5 * len(columns) * math.log(worth)
    best = max(found, key=lambda one: found[one])
    weights = softmax(list(found.values()))
    return reply(
        log,
        dict(zip(found, weights.tolist(), strict=True)),
        why="no term gains on held-out blocks" if best == "none" else f"its terms gain most, {found[best]:.1f} nats",
        log_evidence=found,
    )


def _thin(x: FloatArray, every: int) -> FloatArray:
    return x[: len(x) // every * every].reshape(-1, every).mean(1)


def _best_lag(u: FloatArray, a: FloatArray | None, v: FloatArray | None, moving: BoolArray, step: float) -> float:
    """The lag [s] whose response to the command is nearest to the acceleration, up to a gain."""
    assert a is not None or v is not None
    slope = gaussian_filter1d(v, _SMOOTH_S / step, order=1) / step if a is None and v is not None else a

    def miss(lag: float) -> float:
        x = lagged(u, lag, step)[moving]
        y = np.asarray(slope)[moving]
        return float(y @ y - (x @ y) ** 2 / max(x @ x, 1e-12))

    return min(np.geomspace(0.05, 2.0, 30).tolist(), key=miss)


def _held_out(
    package: ModuleType,
    slope: FloatArray,
    columns: list[FloatArray],
    block: NDArray[np.intp],
    moving: BoolArray,
    step: float,
) -> FloatArray:
    """Errors of the sparse model at rows that it was not fitted to."""
    if not columns:
        return slope[moving]
    x = np.stack(columns, 1)
    scale = np.maximum(np.sqrt(np.mean(x[moving] ** 2, 0)), 1e-9)
    x = x / scale
    size = float(slope[moving].std())
    errors = []
    for half in range(2):
        held = moving & (block % 2 == half)
        kept = moving & ~held
        if held.sum() < 20 or kept.sum() < 20:
            continue
        model = package.SINDy(
            optimizer=package.STLSQ(threshold=0.005 * size, alpha=1e-6),
            feature_library=package.IdentityLibrary(),
        )
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            # all columns but the first are inputs: only the equation of the slope is identified
            model.fit(x[kept, :1], t=step, x_dot=slope[kept, None], u=x[kept, 1:] if x.shape[1] > 1 else None)
            predicted = model.predict(x[held, :1], u=x[held, 1:] if x.shape[1] > 1 else None)
        errors.append(slope[held] - np.asarray(predicted)[:, 0])
    if not errors:
        raise InputError("sparse_regression: too little motion in the log, needs 40 rows at 20 Hz")
    return np.concatenate(errors)


def _worth(errors: FloatArray) -> float:
    """The equivalent number of independent rows, by their first autocorrelations."""
    e = errors - errors.mean()
    lags = [float(e[i:] @ e[: len(e) - i] / (e @ e)) for i in range(1, 20)]
    total = 0.0
    for r in lags:
        if r < 0.05:
            break
        total += r
    return max(len(e) / (1 + 2 * total), 10.0)


# Terms of a sparse regression, and the effect that each represents.
def terms(
    command: FloatArray, response: FloatArray, speed: FloatArray | None, step: float, channels: int
) -> Iterator[tuple[str, str, list[FloatArray]]]:
    """Effect, its equation and its columns (row,): `motion`, and with two channels their `difference`.

    Columns come from the command, from the lag's `response` to it and from the measured speed, never from the measured
    acceleration, whose noise is in the slope to be explained. Random effects have no term, so a regression of this kind
    cannot name them.
    """
    u, a = command, response
    for name, columns in _of_command(u, a, step):
        yield name, "motion", columns
    if speed is not None:
        for name, columns in _of_speed(u, a, speed, step):
            yield name, "motion", columns
    if channels == 2:
        # the accelerometer's faults are where dv/dt and the measured acceleration differ
        yield "sensor_bias", "difference", [np.ones_like(a)]
        yield "sensor_scale", "difference", [a]
        yield "sensor_lag", "difference", [np.gradient(a, step)]


def _of_command(u: FloatArray, a: FloatArray, step: float) -> Iterator[tuple[str, list[FloatArray]]]:
    yield "dead_time", [_late(u, lag, step) - u for lag in (0.1, 0.2, 0.4)]
    yield "dead_band", [np.clip(u, -0.1, 0.1)]
    yield "backlash", [_play(u, 0.1) - u]
    high, low = np.quantile(u, [0.95, 0.05])
    yield "saturation", [np.maximum(u - high, 0.0), np.minimum(u - low, 0.0)]
    yield "brake_throttle_asymmetry", [np.minimum(u, 0.0), np.where(u < 0, a, 0.0)]
    yield "second_order_actuator", [lagged(a, 0.1, step) - a, lagged(a, 0.3, step) - a]
    after = np.diff(np.sign(u), prepend=np.sign(u[0])) != 0
    yield "hand_over", [-u * (np.convolve(after, np.ones(max(1, round(0.4 / step))))[: len(u)] > 0)]
    error = u - a
    yield "rate_limit", [error - np.clip(error, *np.quantile(error, [0.1, 0.9]))]
    late = np.arange(len(u)) / len(u)
    yield "gain_change", [u * (late > share) for share in (0.3, 0.5, 0.7)]
    yield "driveline_oscillation", [x for hertz in (1.5, 3.0) for x in _resonance(a, hertz, step)]


def _of_speed(u: FloatArray, a: FloatArray, v: FloatArray, step: float) -> Iterator[tuple[str, list[FloatArray]]]:
    middle = max(float(v.mean()), 1.0)
    yield "speed_dependent_lag", [(v / middle - 1) * (u - a)]
    yield "speed_dependent_gain", [(v / middle - 1) * u]
    near = sum(np.exp(-(((v - shift) / 0.7) ** 2)) for shift in (5.0, 8.0, 12.5, 20.0))
    yield "gear_shift", [near * np.maximum(u, 0.0)]
    yield "aerodynamic_drag", [v**2]
    yield "viscous_drag", [v]
    place = np.cumsum(v) * step
    waves = [wave(2 * np.pi * place / length) for length in (300.0, 600.0, 1200.0) for wave in (np.sin, np.cos)]
    yield "road_grade", waves
    yield "constant_resistance", [np.ones_like(v)]
    yield "low_speed_creep", [np.clip(1 - v / 3, 0.0, 1.0)]


def _late(x: FloatArray, lag: float, step: float) -> FloatArray:
    rows = max(1, round(lag / step))
    return np.concatenate([np.full(rows, x[0]), x[:-rows]])


def _play(u: FloatArray, half: float) -> FloatArray:
    at, out = u[0], []
    for x in u.tolist():
        at = min(max(at, x - half), x + half)
        out.append(at)
    return np.array(out)


def lagged(u: FloatArray, lag: float, step: float) -> FloatArray:
    """A command (row,) past a first-order lag [s], settled at its first value."""
    keep = float(np.exp(-step / lag))
    return np.asarray(lfilter([0.0, 1 - keep], [1.0, -keep], u - u[0]) + u[0])


def _resonance(x: FloatArray, hertz: float, step: float, damping: float = 0.08) -> list[FloatArray]:
    """Both phases of a lightly damped mode driven by `x`."""
    pole = np.exp((-damping + 1j * np.sqrt(1 - damping**2)) * 2 * np.pi * hertz * step)
    rung = lfilter([0.0, 1.0], [1.0, -pole], np.diff(x, prepend=x[0]))
    return [np.real(rung), np.imag(rung)]
