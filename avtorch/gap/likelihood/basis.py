"""Smooth basis functions of a signal, for regressions that test residuals for structure."""

from __future__ import annotations

import numpy as np
from scipy.signal import lfilter

from avtorch.arrays import Float, FloatArray


def lowpass(x: Float[FloatArray, " row"], seconds: float, dt: float) -> Float[FloatArray, " row"]:
    """x (row,) through a first-order lag, in steady state at its first value."""
    share = -np.expm1(-dt / seconds)
    return np.asarray(lfilter([share], [1, share - 1], x - x[0])) + x[0]


def linear_splines(x: Float[FloatArray, " row"], knots: int) -> Float[FloatArray, "function row"]:
    """Piecewise linear basis functions (function, row) of x (row,), each 1 at one of its quantiles."""
    at = np.unique(np.quantile(x, np.linspace(0.01, 0.99, knots)))
    if len(at) < 2:
        return np.zeros((1, len(x)))
    return np.stack([np.interp(x, at, one) for one in np.eye(len(at))])
