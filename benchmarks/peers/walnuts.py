"""WALNUTS (walnutpie): step sizes that adapt within a trajectory, on the six sums by a compiled callback.

Settings: ``warmup`` and ``draws``, numbers of iterations, and ``chains``. It adapts a diagonal metric.
"""

from __future__ import annotations

import ctypes
import math

import numpy as np
import walnutpie
from numba import carray, cfunc, njit, types

from avtorch.arrays import FloatArray
from benchmarks.peers.contract import Answer, Settings
from benchmarks.peers.problem import LOG_SD, MEDIAN, SIGMA_SCALE, Windows

_LOG_2PI = math.log(2 * math.pi)
_CENTRE = (math.log(MEDIAN[0]), math.log(MEDIAN[1]), math.log(0.5 * SIGMA_SCALE))


@njit(cache=True)
def _value(z, sums, gradient):
    """Log density at ``z``, ``(3,)``, from ``(n, jj, aj, uj, aa, au, uu)``; its gradient is written."""
    n, jj, aj, uj, aa, au, uu = sums[0], sums[1], sums[2], sums[3], sums[4], sums[5], sums[6]
    b, g = np.exp(-z[0]), np.exp(z[1] - z[0])
    precision, square = np.exp(-2 * z[2]), (np.exp(z[2]) / SIGMA_SCALE) ** 2
    chi2 = jj + 2 * b * aj - 2 * g * uj + b * b * aa - 2 * b * g * au + g * g * uu
    on_b, on_g = 2 * (aj + b * aa - g * au), 2 * (g * uu - uj - b * au)
    lag, gain = (z[0] - _CENTRE[0]) / LOG_SD[0], (z[1] - _CENTRE[1]) / LOG_SD[1]
    gradient[0] = 0.5 * precision * (b * on_b + g * on_g) - lag / LOG_SD[0]
    gradient[1] = -0.5 * precision * g * on_g - gain / LOG_SD[1]
    gradient[2] = chi2 * precision - n - square + 1
    value = -0.5 * chi2 * precision - n * (z[2] + 0.5 * _LOG_2PI)
    value += -0.5 * (lag * lag + gain * gain) - np.log(LOG_SD[0] * LOG_SD[1]) - _LOG_2PI
    return value + 0.5 * np.log(2 / np.pi) - np.log(SIGMA_SCALE) - 0.5 * square + z[2]


_DOUBLES = types.CPointer(types.double)


@cfunc(types.intc(types.size_t, _DOUBLES, _DOUBLES, _DOUBLES, _DOUBLES))
def _callback(size, z, gradient, value, sums):
    carray(value, (1,))[0] = _value(carray(z, (3,)), carray(sums, (7,)), carray(gradient, (3,)))
    return 0


class Runner:
    def __init__(self, settings: Settings) -> None:
        self.settings = settings

    def log_density(self, windows: Windows, z: FloatArray) -> FloatArray:
        return np.array([_value(x, windows.sums()[0], np.empty(3)) for x in z])

    def run(self, windows: Windows, seed: int) -> Answer:
        s, sums = self.settings, np.ascontiguousarray(windows.sums()[0])
        g = np.random.default_rng(seed)
        found = walnutpie.walnuts_pyfunc(
            (walnutpie.logp_cfunc_type(_callback.address), ctypes.c_void_p(sums.ctypes.data)),
            inits=np.array(_CENTRE) + 0.1 * g.standard_normal((s["chains"], 3)),
            num_chains=s["chains"],
            seed=seed,
            min_warmup_iter=s["warmup"],
            max_warmup_iter=s["warmup"],
            min_sampling_iter=s["draws"],
            max_sampling_iter=s["draws"],
        )
        return Answer(np.exp(np.stack([np.asarray(chain)[..., -3:] for chain in found])[:, :, None]))
