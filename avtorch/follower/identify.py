"""Law, lag and delay estimated from a car-following log, with intervals that cover the spread between its parts.

Speeds are compared in the engine's coefficients under the noise of `loop_noise`, because a real controller does much
that no law predicts. The likelihood alone gives intervals that are too narrow, so the spread between fits to parts of
the drive widens them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from avtorch.arrays import FloatArray
from avtorch.errors import InputError
from avtorch.follower.followed import Followed
from avtorch.follower.loop_noise import LoopNoise
from avtorch.gap.simulator.effect import delay_key

_ITERATIONS = 30
_ENOUGH = 0.01  # nats that a last step gains
_STEP = 1e-4  # of finite differences
_LONGEST = 1.0  # step, in standard deviations of the prior
_FARTHEST = 5.0
_DRAWS = 2000
_PART_S = 60.0
_PARTS = 6
_DELAYS_S = (0.3, 1.2)


@dataclass(frozen=True, eq=False)
class Identified:
    """`z` (coordinate,) at the mode, its `covariance`; `log_evidence` [nats] of the fit.

    `noise` (bin,): variance of the differenced speed's coefficients [(m/s²)²].

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
    noise: FloatArray = field(repr=False)
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


def identified(candidate: Followed, *, start: Identified | None = None) -> Identified:
    """The fit to the candidate's log, from a short and a long delay, or from another fit's place."""
    places = [_mode(candidate, z) for z in (_starts(candidate) if start is None else [start.z])]
    best = max(places, key=lambda place: place.value)
    information = _curvature(candidate, best)[0]
    size = np.linalg.slogdet(information)[1] + np.linalg.slogdet(best.noise.information)[1]
    covariance = np.asarray(np.linalg.inv(information), np.float64)
    return Identified(candidate, best.z, covariance, best.noise.variance, best.value - 0.5 * float(size))


def widened(found: Identified) -> FloatArray:
    """The fit's covariance, each coordinate widened by the excess spread of fits to parts of its log."""
    own = found.candidate
    count = int(min(_PARTS, own.seconds // _PART_S))
    if count < 2:
        return found.covariance
    edges = [*own.data.source[np.arange(count) * len(own.data.source) // count].tolist(), own.log.rows]
    parts = []
    for first, last in pairwise(edges):
        try:
            part = own.on(own.log[first:last])
        except InputError:  # no stretch of it is long enough
            continue
        if part.seconds > 0.3 * _PART_S:
            parts.append(identified(part, start=found).z)
    if len(parts) < 2:
        return found.covariance
    # the same prior pulls each part: their spread is a lower bound on the uncertainty
    between = np.var(parts, axis=0, ddof=1) / len(parts)
    wider = np.sqrt(np.maximum(between / np.diag(found.covariance), 1.0))
    return found.covariance * np.outer(wider, wider)


class _Place(NamedTuple):
    """`value` [nats] of log likelihood and prior at `z` (coordinate,), the `residual` (frame, bin), its `noise`."""

    z: FloatArray
    value: float
    residual: FloatArray
    noise: LoopNoise


def _at(own: Followed, z: FloatArray, before: LoopNoise | None = None) -> _Place:
    residual, lag = own.residual(z[None])[0], float(own.values(z[None])["T_L"])
    noise = LoopNoise.of(own.data, residual, lag, None if before is None else before.w)
    return _Place(z, noise.value - 0.5 * float(z @ z), residual, noise)


def _curvature(own: Followed, at: _Place) -> tuple[FloatArray, FloatArray]:
    """Information (coordinate, coordinate) and gradient (coordinate,) under the noise at a place; all derivatives are
    one batch of rollouts."""
    ahead = own.residual(at.z + _STEP * np.eye(own.size))
    sd = np.sqrt(at.noise.variance)
    slopes = ((at.residual - ahead) / (_STEP * sd)).reshape(own.size, -1)
    return slopes @ slopes.T + np.eye(own.size), slopes @ (at.residual / sd).ravel() - at.z


def _mode(own: Followed, z: FloatArray) -> _Place:
    """Gauss-Newton with damped steps. A step across a crease of the delay gains nothing and is shortened."""
    at, damping = _at(own, z), 1e-3
    for _ in range(_ITERATIONS):
        information, gradient = _curvature(own, at)
        better = None
        while better is None and damping < 1e4:
            step = np.linalg.solve(information + damping * np.diag(np.diag(information)), gradient)
            step *= min(1.0, _LONGEST / max(float(np.abs(step).max()), 1e-12))
            new = _at(own, np.clip(at.z + step, -_FARTHEST, _FARTHEST), at.noise)
            if new.value > at.value:
                better = new
            else:
                damping = max(damping * 8, 1e-2)
        if better is None:
            break
        gain, at, damping = better.value - at.value, better, damping / 10
        if gain < _ENOUGH:
            break
    return at


def _starts(candidate: Followed) -> list[FloatArray]:
    if delay_key() not in [c.key for c in candidate.coordinates]:
        return [np.zeros(candidate.size)]
    return [candidate.z_of({delay_key(): delay}) for delay in _DELAYS_S]


def _root(covariance: FloatArray) -> FloatArray:
    """A root of a covariance, valid also where round-off made it indefinite."""
    values, vectors = np.linalg.eigh(0.5 * (covariance + covariance.T))
    return vectors * np.sqrt(np.maximum(values, 1e-14))
