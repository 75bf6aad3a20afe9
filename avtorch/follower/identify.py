"""Law, lag and delay estimated from a car-following record, with intervals that cover the spread between its parts.

The noise is an Ornstein-Uhlenbeck force and jerk noise (with the prior of a gust), because a real controller does much
that no law predicts. The likelihood alone gives intervals that are too narrow, so the spread between fits to parts of
the drive widens them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from avtorch.arrays import FloatArray
from avtorch.follower.followed import Followed
from avtorch.gap.drive_record import Record
from avtorch.gap.likelihood.gauss_newton import finish, modes, residuals
from avtorch.gap.likelihood.noise_fit import GUST, fit_noise
from avtorch.gap.likelihood.noise_model import NoiseModel
from avtorch.gap.likelihood.whitening_filter import WhiteningFilter
from avtorch.gap.simulator.effect import delay_key

_START = NoiseModel(process_sd=0.05, force_sd=0.1, speed_sd=0.02)
_TURNS = 5
_DRAWS = 2000
_PART_S = 60.0
_PARTS = 6
_DELAYS_S = (0.3, 1.2)


@dataclass(frozen=True, eq=False)
class Identified:
    """`z` (coordinate,) at the mode, its `covariance`, `noise`; `log_evidence` [nats] of the fit.

    Example:
        >>> from avtorch import Leader, LinearController, simulate
        >>> from avtorch.follower import Identified, diagnose_follower
        >>> car = LinearController(gains=(0.2, 0.6, 0.0), time_gap=1.5)
        >>> log = simulate(Leader.default(start=50.0, duration=45.0, dt=0.1), car).log()
        >>> fit: Identified = diagnose_follower(log, law="constant_time_gap", cause=False).identified
        >>> round(float(fit.values["law.time_gap_s"]), 1), fit.draws(count=100)["T_L"].shape
        (1.5, (100,))
    """

    candidate: Followed = field(repr=False)
    z: FloatArray
    covariance: FloatArray = field(repr=False)
    noise: NoiseModel
    log_evidence: float

    @property
    def values(self) -> Mapping[str, float]:
        """Parameters at the mode, by key: `law.*`, `T_L` [s], `dead_time.delay_s` [s]."""
        return {k: float(v[0]) for k, v in self.candidate.values(self.z[None]).items()}

    def draws(
        self, covariance: FloatArray | None = None, *, count: int = _DRAWS, seed: int = 0
    ) -> dict[str, FloatArray]:
        """Parameters (draw,) of a normal posterior in `z`."""
        noise = np.random.default_rng(seed).standard_normal((count, len(self.z)))
        spread = _root(self.covariance if covariance is None else covariance)
        z = np.clip(self.z + noise @ spread.T, -8.0, 8.0)
        return {k: x.numpy() for k, x in self.candidate.values(z).items()}

    def errors(self, record: Record) -> FloatArray:
        """Residuals, measured minus simulated, (channel, counted, group) at the rows of `record`."""
        return self.candidate.on(record).errors(self.z[None])[0]


def identified(candidate: Followed, record: Record | None = None, *, start: Identified | None = None) -> Identified:
    """Fit to `record` (default: all rows), parameters and noise in turn, from a short and a long delay."""
    record = candidate.record if record is None else record
    own = candidate.on(record)
    noise, value = _START if start is None else start.noise, -np.inf
    z = _starts(own) if start is None else start.z[None]
    for _ in range(_TURNS):
        white = WhiteningFilter(record, noise)
        tried, worth = modes(own, white, z, iterations=12, enough=0.1)
        z = tried[[int(np.argmax(worth))]]
        errors = residuals(own, white, z[0], coarse=False)
        lag = float(own.values(z)["T_L"][0])
        fitted = fit_noise(record, errors, noise, T_L=lag, priors=GUST, iterations=4)
        noise = fitted.noise
        new = float(fitted.rows.sum()) + fitted.log_prior - 0.5 * float(z[0] @ z[0])
        if new < value + 0.5:
            break
        value = new
    fit = finish(own, WhiteningFilter(record, noise), z[0])
    return Identified(candidate, fit.z, fit.covariance, noise, fit.log_evidence + fitted.log_prior)


def widened(found: Identified, record: Record) -> FloatArray:
    """The fit's covariance, each coordinate widened by the excess spread of fits to parts of `record`."""
    count = int(min(_PARTS, record.rows * record.dt // _PART_S))
    if count < 2:
        return found.covariance
    edges = np.linspace(0, record.rows, count + 1).astype(int)
    numbers = np.arange(record.rows)
    parts = []
    for first, last in pairwise(edges.tolist()):
        part = record.only((numbers >= first) & (numbers < last))
        if part.rows * part.dt > 0.3 * _PART_S:
            parts.append(identified(found.candidate, part, start=found).z)
    if len(parts) < 2:
        return found.covariance
    # the same prior pulls each part: their spread is a lower bound on the uncertainty
    between = np.var(parts, axis=0, ddof=1) / len(parts)
    wider = np.sqrt(np.maximum(between / np.diag(found.covariance), 1.0))
    return found.covariance * np.outer(wider, wider)


def _starts(candidate: Followed) -> FloatArray:
    centre = np.zeros(candidate.size)
    keys = [c.key for c in candidate.coordinates]
    if delay_key() not in keys:
        return centre[None]
    at = keys.index(delay_key())
    out = np.tile(centre, (len(_DELAYS_S), 1))
    out[:, at] = [candidate.coordinates[at].z_of(d) for d in _DELAYS_S]
    return out


def _root(covariance: FloatArray) -> FloatArray:
    """A root of a covariance, valid also where round-off made it indefinite."""
    values, vectors = np.linalg.eigh(0.5 * (covariance + covariance.T))
    return vectors * np.sqrt(np.maximum(values, 1e-14))
