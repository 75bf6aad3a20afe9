"""The evidence of a hypothesis, by Laplace's approximation.

    log E = min(gain below 10 Hz, gain of the whole band) + log integral over errors of shape + log prior
            + d/2 log 2 pi - 1/2 log det H

Gains are over the base, the hypothesis without effects and without a force map. Sizes have a heavy-tailed prior
(Student, three degrees of freedom) that vanishes where an effect would make no difference (non-local; Johnson and
Rossell 2010).
"""

from __future__ import annotations

import math

import numpy as np

from avtorch.gap.engine.coordinates import COORDINATES, EFFECTS, INDEX
from avtorch.gap.engine.gauss_newton import linearised, normal_prior, whitened_under_noise
from avtorch.gap.engine.hypothesis import Hypothesis
from avtorch.gap.engine.likelihood import claimed, freedom, log_sum
from avtorch.gap.engine.priors import LOST_NATS, ONSET_ODDS, SHIFT_NATS, TRIED_NATS
from avtorch.gap.engine.shape_error import effect_energy, log_prior, shape_likelihood

_HALF_LOG_2PI = 0.5 * math.log(2 * math.pi)
_STUDENT_3 = math.log(2 / (math.pi * math.sqrt(3)))  # log density at the centre, scale 1
_IMPOSSIBLE = -60.0  # nats: an effect of no size; finite, so that sets compare
_ROUNDS = 4  # until the noise beside a force map has settled within a tenth of a nat
_BASE_SD = {"T_L": 0.7, "K_L": 0.3}  # of log T_L; scale of K_L, as `simulator.plant.BASELINE` has them


def log_prior_density(h: Hypothesis) -> float:
    """Log density of the priors at the hypothesis's values [nats]."""
    total = 0.0
    for name in h.free:
        x = h[name]
        mean, scale = normal_prior(name, h.neutral[INDEX[name]])
        if name == "T_L":
            z = (math.log(x) - mean) / _BASE_SD[name]
            total += -0.5 * z * z - math.log(_BASE_SD[name] * x) - _HALF_LOG_2PI
        elif name in COORDINATES and COORDINATES[name].mean is None:
            c = COORDINATES[name]
            total += _student((x - mean) / c.scale) - math.log(c.scale) + (0.0 if c.signed else math.log(2))
        elif name == "K_L":
            total += _student((x - mean) / _BASE_SD[name]) - math.log(_BASE_SD[name])
        else:
            total += -0.5 * ((x - mean) / scale) ** 2 - math.log(scale) - _HALF_LOG_2PI
    return total + sum(_size_density(h, e) for e in h.effects)


def evaluate_evidence(h: Hypothesis) -> Hypothesis:
    """Laplace's approximation of the evidence of `h` over its base, and what else `Hypothesis` says is set here.

    `h` was simulated at its most probable values; it is changed and returned. `information` is the Hessian H.
    """
    base = h.base or h
    names = h.free
    h.jacobian, precision, _ = linearised(h, names)
    W = whitened_under_noise(h, h.jacobian, precision, _ROUNDS)
    h.information = W @ W.T + np.diag(precision)
    h.claimed = claimed(h.data, h.covariance)
    first = base.plain or base
    first_claimed = claimed(first.data, first.covariance)
    h.effect_energy, h.shape, h.shape_log = None, None, np.zeros(1)
    if h.effects and h.predicted.shape == base.predicted.shape:
        h.effect_energy = effect_energy(h.data, h.predicted - base.predicted)
        h.shape = shape_likelihood(h.data, h.residual, h.effect_energy)
    if h.shape is not None:
        h.shape_log = h.shape.nats + log_prior(h.effects)
    gain = min(h.claimed - first_claimed, h.log_likelihood - first.log_likelihood)
    volume = len(names) * _HALF_LOG_2PI - 0.5 * float(np.linalg.slogdet(h.information)[1])
    h.evidence = gain + log_sum(h.shape_log) + log_prior_density(h) + volume + _onset_odds(h) + _force_density(h)
    h.evidence -= LOST_NATS * len(h.lost) + SHIFT_NATS * len(h.shift_speeds) * ("gear_shift" in h.effects)
    h.score = h.evidence - TRIED_NATS * (len(h.effects) + (h.force is not None))
    return h


def _force_density(h: Hypothesis) -> float:
    """Log density of the coefficients of a force map, whose 2 pi the volume has not, and of its sizes."""
    if h.force is None:
        return 0.0
    b, size = h.force_coefficients, h.force.size
    free = 0.0 if h.force_spread is None else freedom(h.data, h.covariance, h.force_spread)
    return h.force.size_nats + 0.5 * free - 0.5 * float(b @ b) / size**2 - len(b) * math.log(size)


def _student(z: float) -> float:
    return _STUDENT_3 - 2 * math.log1p(z * z / 3)


def _size_density(h: Hypothesis, effect: str) -> float:
    size = EFFECTS[effect].size(h.values, h.neutral)
    return max(-1 / max(size * size, 1e-9), _IMPOSSIBLE)


def _onset_odds(h: Hypothesis) -> float:
    """A moment is one of as many as there are frames; several effects may set in at it."""
    total = -len(set(h.onsets.values())) * math.log(max(h.data.frame_count, 4))
    for e in h.effects:
        when = EFFECTS[e].onset
        if e in h.onsets:
            total += math.log(ONSET_ODDS)
        elif when == "must":
            total += _IMPOSSIBLE
        elif when == "may":
            total += math.log(1 - ONSET_ODDS)
    return total
