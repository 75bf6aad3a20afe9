"""Heavy tails of the accelerometer: outliers, a random effect that no rollout predicts.

They affect single rows at the log's own rate, on top of any other cause, so they are scored by the likelihood ratio of
single rows, given the errors of a rollout.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from scipy.optimize import minimize

from avtorch.arrays import BoolArray, FloatArray
from avtorch.gap.search.onset import allowed


@dataclass(frozen=True, eq=False)
class HeavyTails:
    """Heavy tails: `evidence` [nats] over a normal distribution, `fraction`, `scale` with sds on their links' scales.

    `hit` (row,): rows more likely outliers than not. `ratios` (row,): log likelihood ratio of each row. `z`
    (coordinate,), `covariance`: of the law's own parameters.
    """

    evidence: float
    fraction: float
    scale: float
    sds: tuple[float, float]
    hit: BoolArray
    ratios: FloatArray = field(repr=False)
    onset: int | None = None
    z: FloatArray | None = field(default=None, repr=False)
    covariance: FloatArray | None = field(default=None, repr=False)

    @property
    def plain(self) -> bool:
        """Whether single rows are clear outliers and should be removed from the log."""
        return self.evidence > _PLAIN and bool(self.hit.any())


_PLAIN = 2.0  # nats over a normal distribution
_TAIL_PRIOR = ((np.log(0.01), 1.5), (np.log(7.0), 0.4))


_LEVEL_S = 20.0  # length over which noise is stationary: an onset of gusts raises its level without any outlier


def _level(x: FloatArray, size: int) -> FloatArray:
    """Running median (row,) of x (row,) over blocks of about `size` rows, interpolated linearly between their centres.

    Each block takes the largest value of its neighbourhood, so that at a rise no row is compared with the lower level.
    """
    ends = np.linspace(0, len(x), max(1, round(len(x) / max(size, 1))) + 1).astype(int)
    own = np.pad([float(np.median(x[a:b])) for a, b in pairwise(ends)], 1, mode="edge")
    medians = np.maximum(own[1:-1], np.maximum(own[:-2], own[2:]))
    return np.asarray(np.interp(np.arange(len(x)), 0.5 * (ends[1:] + ends[:-1]), medians))


def _outliers(z: FloatArray) -> tuple[float, float]:
    """`(fraction, scale)` of the effect `outliers`."""
    fraction, scale = (float(np.exp(centre + sd * x)) for (centre, sd), x in zip(_TAIL_PRIOR, z, strict=True))
    return min(fraction, 0.5), scale


def heavy_tails(
    errors: FloatArray,
    dt: float,
    *,
    fits: BoolArray | None = None,
    law: Callable[[FloatArray], tuple[float, float]] = _outliers,
    size: int = 2,
) -> HeavyTails:
    """Outliers among accelerometer errors (row,), by their distance from neighbouring rows.

    A row is compared with the median of the two rows before and the two after it, which a single outlier does not
    change. The median of these distances estimates the size of the noise. `fits` (row,): rows used to fit fraction and
    scale, all by default. `law`: fraction and scale as functions of `size` coordinates, standard normal a priori.
    """
    fits = np.ones(len(errors), bool) if fits is None else fits
    x = np.pad(errors, 2, mode="edge")
    beside = np.median(np.stack([x[:-4], x[1:-3], x[3:-1], x[4:]]), 0)
    away = errors - beside
    # a jump of the car affects all neighbouring rows, an outlier one
    sd = np.maximum(1.4826 * _level(np.abs(away - np.median(away)), round(_LEVEL_S / dt)), 1e-9)
    spread = np.abs(np.stack([x[:-4], x[1:-3], x[3:-1], x[4:]]) - beside)
    rough = np.sort(spread, 0)[1]  # of four neighbours, those nearest to their median
    away = away / np.maximum(sd, rough)

    def ratios(z: FloatArray) -> FloatArray:
        fraction, scale = law(z)
        # in units of the distances' own sd, about 1.15 times the noise's
        wide = 1 + (scale / 1.15) ** 2
        gain = -0.5 * np.log(wide) + 0.5 * away**2 * (1 - 1 / wide)
        return np.log1p(fraction * np.expm1(np.minimum(gain, 500.0)))

    def cost(z: FloatArray) -> float:
        return -float(ratios(z)[fits].sum()) + 0.5 * float(z @ z)

    begin = [np.eye(1, size)[0] * a for a in (-1.5, 0.5)] if size else []
    found = [minimize(cost, at, method="Nelder-Mead") for at in begin]
    z = min(found, key=lambda m: m.fun).x if found else np.zeros(0)
    per_row = ratios(z)
    hessian = hessian_of(cost, z)
    evidence = -cost(z) - 0.5 * float(np.linalg.slogdet(hessian)[1])
    covariance = np.asarray(np.linalg.inv(hessian), np.float64)
    sds = np.sqrt(np.diag(covariance)) * [sd for _, sd in _TAIL_PRIOR] if law is _outliers else np.zeros(2)
    fraction, scale = law(z)
    wide = 1 + (scale / 1.15) ** 2
    hit = np.log(max(fraction, 1e-300)) - np.log1p(-fraction) - 0.5 * np.log(wide) + 0.5 * away**2 * (1 - 1 / wide) > 0
    onset, gained = onset_of(per_row, dt)
    return HeavyTails(
        evidence=evidence + float(np.logaddexp(0.0, gained)) - float(np.log(2.0)),
        fraction=fraction,
        scale=scale,
        sds=(float(sds[0]), float(sds[1])),
        hit=hit & (np.abs(away) > 3.5),
        ratios=per_row,
        onset=onset if gained > 1 else None,
        z=z,
        covariance=covariance,
    )


def hessian_of(cost, z: FloatArray, h: float = 0.05) -> FloatArray:  # type: ignore[no-untyped-def]
    size = len(z)
    out = np.empty((size, size))
    for i in range(size):
        for j in range(size):
            a, b = np.eye(size)[i] * h, np.eye(size)[j] * h
            out[i, j] = (cost(z + a + b) - cost(z + a - b) - cost(z - a + b) + cost(z - a - b)) / (4 * h * h)
    out = 0.5 * (out + out.T)
    values, vectors = np.linalg.eigh(out)
    return (vectors * np.maximum(values, 1.0)) @ vectors.T


def onset_of(ratios: FloatArray, dt: float) -> tuple[int, float]:
    """Best onset row of per-row ratios, and its gain net of the cost of the unknown onset [nats]."""
    after = np.cumsum(ratios[::-1])[::-1]
    within = allowed(len(ratios), dt)
    best = within.start + int(np.argmax(after[within]))
    mass = np.exp(after[within] - after[best]).sum()
    return best, float(after[best] - after[0] + np.log(mass / len(ratios)))
