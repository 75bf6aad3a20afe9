"""Quality of an answer: effective draws, and its distance from the exact posterior."""

from __future__ import annotations

import statistics
import warnings
from dataclasses import dataclass

import numpy as np

from avtorch.arrays import FloatArray
from benchmarks.peers.contract import Answer, moments
from benchmarks.peers.problem import Windows

#: Effective draws requested of every sampler.
WANTED = 2000
#: ArviZ estimates autocorrelation from halves of chains; chains shorter than this are uninformative for it, and the
#: spread of their means is used instead.
SHORT = 50
LEAST_CHAINS = 64


@dataclass(frozen=True)
class Exact:
    """Means and SDs by quadrature, ``(window, 3)``."""

    mean: FloatArray
    sd: FloatArray

    @classmethod
    def of(cls, windows: Windows) -> Exact:
        from avtorch.inference import integrate
        from benchmarks.peers.own import density_of

        parts = [integrate(density_of(windows.select(slice(k, k + 10)))) for k in range(0, len(windows), 10)]
        if not all(bool(part.converged.all()) for part in parts):
            raise RuntimeError("quadrature did not converge on every window: no truth to compare with")
        return cls(np.concatenate([p.mean for p in parts]), np.concatenate([p.sd for p in parts]))

    def select(self, index: slice) -> Exact:
        return Exact(self.mean[index], self.sd[index])


@dataclass(frozen=True)
class Score:
    """Scores of the windows of an answer.

    Attributes:
        bulk, tail: least effective draws over the parameters, ``(window,)``; NaN without draws.
        shift: mean difference in exact SDs, and ``ratio``: SD over the exact SD; ``(window, parameter)``.
    """

    bulk: FloatArray
    tail: FloatArray
    shift: FloatArray
    ratio: FloatArray

    @classmethod
    def of(cls, answer: Answer, exact: Exact) -> Score:
        mean, sd = moments(answer)
        nothing = np.full(len(mean), np.nan)
        bulk, tail = (nothing, nothing) if answer.draws is None else effective(answer.draws)
        if answer.ess is not None:
            bulk, tail = np.minimum(bulk, answer.ess), np.minimum(tail, answer.ess)
        return cls(bulk, tail, (mean - exact.mean) / exact.sd, sd / exact.sd)

    @classmethod
    def join(cls, scores: list[Score]) -> Score:
        return cls(*(np.concatenate([getattr(s, name) for s in scores]) for name in cls.__dataclass_fields__))


def effective(draws: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Bulk and tail effective draws of the worst parameter, each ``(window,)``; never above the number of draws.

    ArviZ's, but for many chains of fewer than ``SHORT`` draws: there its estimate saturates, and the variance of the
    chains' means over that of independent draws is used instead, on the same rank-normalised draws and tail indicators.
    """
    chains, length, windows, parameters = draws.shape
    bulk, tail = np.empty((windows, parameters)), np.empty((windows, parameters))
    arviz = _arviz()
    for w in range(windows):
        for i in range(parameters):
            x = np.ascontiguousarray(draws[:, :, w, i])
            if length < SHORT and chains >= LEAST_CHAINS:
                low, high = np.quantile(x, [0.05, 0.95])
                bulk[w, i] = _between(_normal_ranks(x))
                tail[w, i] = min(_between((x <= low) * 1.0), _between((x <= high) * 1.0))
            else:
                bulk[w, i] = float(arviz.ess(x, method="bulk"))
                tail[w, i] = float(arviz.ess(x, method="tail"))
    total = chains * length
    return np.minimum(bulk.min(-1), total), np.minimum(tail.min(-1), total)


def _between(x: FloatArray) -> float:
    """Effective draws from the means of independent chains: ``chains * variance / variance of the chain means``."""
    return float(len(x) * x.var() / max(x.mean(1).var(ddof=1), 1e-300))


def _normal_ranks(x: FloatArray) -> FloatArray:
    from scipy.stats import norm, rankdata

    return norm.ppf((rankdata(x).reshape(x.shape) - 0.375) / (x.size + 0.25))


def _arviz():
    with warnings.catch_warnings():
        # ArviZ 0.23 announces its successor on import
        warnings.filterwarnings("ignore", r"\s*ArviZ is undergoing a major refactor", FutureWarning)
        import arviz
    return arviz


def seconds_to(wanted: float, seconds: float, ess: float) -> float:
    """Seconds to ``wanted`` effective draws: as measured if there were that many, else scaled up in proportion.

    Not scaled down: warm-up and the search for the mode do not shrink with the draws.
    """
    return seconds * max(1.0, wanted / ess)


def median(values: list[float]) -> float:
    return statistics.median(values) if values else float("nan")
