"""The noise model fitted to the residuals of a rollout: scoring steps on the innovations' likelihood."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from itertools import product

import numpy as np

from avtorch.arrays import Float, FloatArray
from avtorch.gap.drive_record import Record
from avtorch.gap.likelihood.noise_model import NAMES, NoiseModel
from avtorch.gap.likelihood.noise_segments import before_onset, whitening_filter
from avtorch.gap.likelihood.random_law import RandomLaw
from avtorch.gap.likelihood.whitening_filter import WhiteningFilter

Prior = tuple[float, float, float]

PRIORS: dict[str, Prior] = {
    "process_sd": (np.log(0.05), 1.2, 4.0),
    "process_time": (0.0, 0.3, 2.0),
    "force_sd": (np.log(0.005), 0.5, 1.5),
    "force_time": (np.log(3.0), 0.3, 1.0),
    "accel_sd": (np.log(0.05), 1.2, 4.0),
    "speed_sd": (np.log(0.02), 1.2, 4.0),
}
"""Log-normal priors: mean and sd of the logarithm, and the number of sds at which they are truncated.

White jerk noise passes the actuator's lag, so `process_time` is in units of `T_L`. The prior keeps the nuisance force
small and slow: a free force would absorb whatever no hypothesis predicts, including every cause.
"""

GUST: dict[str, Prior] = {
    **PRIORS,
    "force_sd": (np.log(0.1), 1.0, 4.0),
    "force_time": (np.log(2.2), 0.63, 2.5),
}
"""Priors where the coloured force is itself the cause."""

_LAW_END = 4.0  # limit in prior standard deviations for a random effect's parameter
_STEP = 1e-3
_LONGEST = 1.5  # longest step, in prior standard deviations
_TRIES = 8  # tries of a step, each shorter; far from the mode squared scores do not estimate the information


@dataclass(frozen=True, eq=False)
class NoiseFit:
    """`noise` at its mode; `log_prior` there with Laplace's term: its contribution to a log evidence.

    `rows` (counted,): log likelihood of each row; `sds` of the logarithms, by name. `law_z` (coordinate,),
    `law_covariance`: of a random effect's force fitted jointly.
    """

    noise: NoiseModel
    log_prior: float
    rows: Float[FloatArray, " counted"] = field(repr=False)
    sds: Mapping[str, float] = field(repr=False)
    law_z: Float[FloatArray, " law_coordinate"] | None = field(default=None, repr=False)
    law_covariance: Float[FloatArray, "law_coordinate law_coordinate"] | None = field(default=None, repr=False)


def fit_noise(
    record: Record,
    errors: Float[FloatArray, "channel counted group"],
    start: NoiseModel,
    *,
    T_L: float,
    priors: Mapping[str, Prior] = PRIORS,
    onset: int | None = None,
    gust_onset: int | None = None,
    iterations: int = 6,
    law: RandomLaw | None = None,
    law_z: Float[FloatArray, " law_coordinate"] | None = None,
) -> NoiseFit:
    """Mode of the noise parameters given the errors (channel, counted, group) of a rollout; `T_L` [s].

    Errors averaged over groups have group size 1. Before `onset` the sensor has neither lag nor scale error, before
    `gust_onset` the force has its nuisance size. `law`: of a random effect whose force is fitted jointly, from `law_z`
    (coordinate,) on.
    """
    means = np.array([priors[n][0] for n in NAMES])
    means[NAMES.index("process_time")] += np.log(T_L)
    sds, ends = (np.array([priors[n][k] for n in NAMES]) for k in (1, 2))
    size, extra = len(NAMES), 0 if law is None else law.size
    ends = np.concatenate([ends, np.full(extra, _LAW_END)])

    onsets = {"onset": onset, "gust_onset": gust_onset}

    def model(z: FloatArray) -> NoiseModel:
        own = {n: float(x) for n, x in zip(NAMES, np.exp(means + sds * z[:size]), strict=True)}
        # a force of exactly zero would make its state singular
        more = {} if law is None else {k: max(x, 1e-6) for k, x in law.force(z[size:]).items()}
        return replace(start, **own, **more)

    coarse = errors.shape[-1] == 1

    def scored(z: FloatArray) -> tuple[FloatArray, float, float]:
        """Each row's log likelihood, the log joint density, and the mean square of the white errors."""
        white = whitening_filter(record, model(z), **onsets)
        rows = white.row_likelihoods(errors)
        total = float(rows.sum())
        square = 2 * (white.constant_of(coarse=coarse) - total) / errors.size
        return rows, total - 0.5 * float(z @ z), square

    begin = np.log([getattr(start, n) for n in NAMES])
    z = np.concatenate([(begin - means) / sds, np.zeros(extra) if law_z is None else law_z])
    z = np.clip(z, -ends, ends)
    rows, value, square = scored(z)
    if not 0.5 < square < 2.0:
        # far from the mode scores mislead: start at the best point of a coarse grid of sizes
        for shifts in product((-1.4, 0.0, 1.4), repeat=3):
            other = z.copy()
            for name, shift in zip(("process_sd", "accel_sd", "speed_sd"), shifts, strict=True):
                other[NAMES.index(name)] = shift
            tried = scored(other)
            if tried[1] > value:
                z, (rows, value, square) = other, tried
    damping, information = 1e-2, np.eye(len(z))
    for _ in range(iterations):
        ahead = [model(x) for x in z + _STEP * np.eye(len(z))]
        before = [before_onset(n, **onsets) for n in ahead]
        whites = WhiteningFilter.each(record, ahead, before, coarse=coarse)
        slopes = np.stack([(w.row_likelihoods(errors) - rows) / _STEP for w in whites])
        # squared scores estimate the information near the mode; far from it they are too large by the square of this
        information = slopes @ slopes.T / max(1.0, square) ** 2 + np.eye(len(z))
        gradient = slopes.sum(1) - z
        # coordinates at a bound with an outward gradient stay fixed
        held = ((z >= ends) & (gradient > 0)) | ((z <= -ends) & (gradient < 0))
        free = np.flatnonzero(~held)
        part = information[np.ix_(free, free)]
        better = False
        for _ in range(_TRIES):
            step = np.linalg.solve(part + damping * np.diag(np.diag(part)), gradient[free])
            step *= min(1.0, _LONGEST / max(float(np.abs(step).max(initial=0)), 1e-12))
            new = z.copy()
            new[free] += step
            new = np.clip(new, -ends, ends)
            after = scored(new)
            if after[1] >= value:
                better = True
                break
            damping = max(damping * 8, 1e-2)
        if not better:
            break
        gained, z, (rows, value, square) = after[1] - value, new, after
        damping *= 0.2
        if gained < 0.02:
            break
    log_prior = -0.5 * float(z @ z) - 0.5 * float(np.linalg.slogdet(information)[1])
    covariance = np.asarray(np.linalg.inv(information), np.float64)
    spread = np.sqrt(np.diag(covariance))[:size] * sds
    named: dict[str, float] = dict(zip(NAMES, spread.tolist(), strict=True))
    if law is None:
        return NoiseFit(model(z), log_prior, rows, named)
    return NoiseFit(model(z), log_prior, rows, named, z[size:], covariance[size:, size:])
