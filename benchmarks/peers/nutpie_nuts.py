"""nutpie on a PyMC model compiled by Numba; the sums are shared data, so a new window compiles nothing.

Settings:
    chains, warmup, draws: a chain; chains run on the one core.
    low_rank: nutpie's low-rank mass matrix in place of the diagonal one.
"""

from __future__ import annotations

import numpy as np
import nutpie
import pymc as pm

from benchmarks.peers.contract import Answer, Settings
from benchmarks.peers.problem import LOG_SD, MEDIAN, NAMES, SIGMA_SCALE, FloatArray, Windows


def _model() -> pm.Model:
    with pm.Model() as model:
        n, jj, aj, uj, aa, au, uu = [pm.Data(name, 1.0) for name in _SUMS]
        lag = pm.LogNormal("T_L", np.log(MEDIAN[0]), LOG_SD[0])
        gain = pm.LogNormal("K_L", np.log(MEDIAN[1]), LOG_SD[1])
        sigma = pm.HalfNormal("sigma", SIGMA_SCALE)
        b, g = 1 / lag, gain / lag
        chi2 = (jj + 2 * b * aj - 2 * g * uj + b * b * aa - 2 * b * g * au + g * g * uu) / sigma**2
        pm.Potential("jerk", -0.5 * chi2 - n * (pm.math.log(sigma) + 0.5 * np.log(2 * np.pi)))
    return model


_SUMS = ("n", "jj", "aj", "uj", "aa", "au", "uu")


class Runner:
    def __init__(self, settings: Settings) -> None:
        self.settings = settings
        self._compiled = None

    def log_density(self, windows: Windows, z: FloatArray) -> FloatArray:
        model = _model()
        with model:
            pm.set_data(dict(zip(_SUMS, windows.sums()[0], strict=True)))
        value = model.compile_logp()
        names = [v.name for v in model.value_vars]
        return np.array([value(dict(zip(names, x, strict=True))) for x in z])

    def run(self, windows: Windows, seed: int) -> Answer:
        if self._compiled is None:  # in the first call, whose extra time is a column of its own
            self._compiled = nutpie.compile_pymc_model(_model(), backend="numba")
        data = self._compiled.with_data(**dict(zip(_SUMS, windows.sums()[0], strict=True)))
        s = self.settings
        trace = nutpie.sample(
            data,
            draws=s["draws"],
            tune=s["warmup"],
            chains=s["chains"],
            cores=1,
            seed=seed,
            save_warmup=False,
            progress_bar=False,
            low_rank_modified_mass_matrix=s["low_rank"],
        )
        found = trace["posterior"]
        return Answer(np.stack([np.asarray(found[name]) for name in NAMES], -1)[:, :, None])
