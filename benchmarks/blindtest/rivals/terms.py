"""Terms of a sparse regression, and the effect that each represents."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.signal import lfilter

from avtorch.arrays import FloatArray


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
