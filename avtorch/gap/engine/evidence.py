"""The evidence of a hypothesis, by Laplace's approximation.

    log E = min(gain below 10 Hz, gain of all bands) + log integral over errors of shape + log prior
            + d/2 log 2 pi - 1/2 log det H + log odds

The odds are those of onsets, of stretches of lost messages, of speeds at which gears shift, and the density of a force
map. A search compares sets by their `score`: the evidence less what one more effect has to gain.

Gains are over the base, the hypothesis without effects and without a force map. Sizes have a heavy-tailed prior
(Student, three degrees of freedom) that vanishes where an effect would make no difference (non-local; Johnson and
Rossell 2010).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from avtorch.gap.engine.coordinates import COORDINATES, EFFECTS, INDEX
from avtorch.gap.engine.drive_data import DriveData
from avtorch.gap.engine.gauss_newton import linear_priors, normal_prior, slopes_of, whitened_under_noise
from avtorch.gap.engine.hypothesis import Hypothesis
from avtorch.gap.engine.likelihood import HALF_LOG_2PI, claimed, freedom, log_sum
from avtorch.gap.engine.priors import LOST_S, ONSET_ODDS, SHIFT_NATS, TRIED_NATS
from avtorch.gap.engine.shape_error import effect_energy, shape_likelihood, shape_log_prior

_STUDENT_3 = math.log(2 / (math.pi * math.sqrt(3)))  # log density at the centre, scale 1
_IMPOSSIBLE = -60.0  # nats: an effect of no size; finite, so that sets compare
_ROUNDS = 4  # until the noise beside a force map has settled within a tenth of a nat
_BASE_SD = {"T_L": 0.7, "K_L": 0.3}  # of log T_L; scale of K_L, as `simulator.plant.BASELINE` has them


def log_prior(h: Hypothesis, names: Sequence[str], x: Tensor) -> Tensor:
    """Log density (...) of the priors [nats] with coordinates `names` at `x` (..., coordinate), others at their values.

    By autograd.
    """
    own = {n: torch.as_tensor(h[n], dtype=x.dtype) for n in h.free} | dict(zip(names, x.unbind(-1), strict=True))
    total = torch.zeros_like(x[..., 0])
    for name, at in own.items():
        mean, scale = normal_prior(name, h.neutral[INDEX[name]])
        if name == "T_L":
            z = (at.log() - mean) / _BASE_SD[name]
            total = total - 0.5 * z * z - at.log() - math.log(_BASE_SD[name]) - HALF_LOG_2PI
        elif name == "K_L":
            total = total + _student((at - mean) / _BASE_SD[name]) - math.log(_BASE_SD[name])
        elif name in COORDINATES and COORDINATES[name].mean is None:
            c = COORDINATES[name]
            sides = 0.0 if c.signed else math.log(2)
            total = total + _student((at - mean) / c.scale) - math.log(c.scale) + sides
        else:
            total = total - 0.5 * ((at - mean) / scale) ** 2 - math.log(scale) - HALF_LOG_2PI
    for effect in h.effects:
        sized = [(own[c.name] - h.neutral[INDEX[c.name]]) / c.faint for c in EFFECTS[effect].coordinates if c.faint]
        if sized:
            square = sum(z * z for z in sized)
            total = total + (-1 / torch.as_tensor(square).clamp_min(1e-9)).clamp_min(_IMPOSSIBLE)
    return total


def evaluate_evidence(h: Hypothesis) -> Hypothesis:
    """Laplace's approximation of the evidence of `h` over its base, and what else `Hypothesis` says is set here.

    `h` was simulated at its most probable values; it is changed and returned. `information` is the Hessian H.
    """
    base = h.base or h
    names = h.free
    h.jacobian = None
    slopes, (precision, _) = slopes_of(h), linear_priors(h, names)
    W = whitened_under_noise(h, slopes, precision, _ROUNDS)
    h.information = W @ W.T + np.diag(precision)
    h.effect_energy, h.shape, h.shape_log = None, None, np.zeros(1)
    if h.effects and h.predicted.shape == base.predicted.shape:
        h.effect_energy = effect_energy(h.data, h.predicted - base.predicted)
        h.shape = shape_likelihood(h.data, h.residual, h.effect_energy)
    if h.shape is not None:
        h.shape_log = h.shape.nats + shape_log_prior(h.effects)
    volume = len(names) * HALF_LOG_2PI - 0.5 * float(np.linalg.slogdet(h.information)[1])
    prior = float(log_prior(h, names, torch.as_tensor(h.values[[INDEX[n] for n in names]])))
    h.evidence = min(gains(h)) + log_sum(h.shape_log) + prior + volume + _onset_odds(h) + _force_density(h)
    h.evidence -= lost_nats(h) * len(h.lost) + SHIFT_NATS * len(h.shift_speeds) * ("gear_shift" in h.effects)
    h.score = h.evidence - TRIED_NATS * (len(h.effects) + (h.force is not None))
    return h


def gains(h: Hypothesis) -> tuple[float, float]:
    """What `h` gains over its base [nats]: in the bands below `claim_hz`, and in all."""
    base = h.base or h
    first = base.plain or base
    claim = claimed(h.data, h.covariance) - claimed(first.data, first.covariance)
    return claim, h.log_likelihood - first.log_likelihood


def lost_nats(h: Hypothesis) -> float:
    """What a stretch of lost messages costs [nats]: it is one of all starts and lengths that the car's lag tells
    apart."""
    lag = max(h["T_L"], h.data.dt)
    return math.log(max(len(h.data.time) * h.data.dt / lag * LOST_S / lag, 1.0))


def _force_density(h: Hypothesis) -> float:
    """Log density of the coefficients of a force map, whose 2 pi the volume has not, and of its sizes."""
    if h.force is None:
        return 0.0
    b, size = h.force_coefficients, h.force.size
    free = 0.0 if h.force_spread is None else freedom(h.data, h.covariance, h.force_spread)
    return h.force.size_nats + 0.5 * free - 0.5 * float(b @ b) / size**2 - len(b) * math.log(size)


def _student(z: Tensor) -> Tensor:
    return _STUDENT_3 - 2 * torch.log1p(z * z / 3)


def onset_nats(data: DriveData) -> float:
    """What it costs an effect to set in at a moment of its own and not to act throughout [nats]: a moment is one of as
    many as there are frames."""
    return _moment_nats(data) + math.log((1 - ONSET_ODDS) / ONSET_ODDS)


def _moment_nats(data: DriveData) -> float:
    return math.log(max(data.frame_count, 4))


def _onset_odds(h: Hypothesis) -> float:
    """Several effects may set in at one moment."""
    total = -len(set(h.onsets.values())) * _moment_nats(h.data)
    for e in h.effects:
        when = EFFECTS[e].onset
        if e in h.onsets:
            total += math.log(ONSET_ODDS)
        elif when == "must":
            total += _IMPOSSIBLE
        elif when == "may":
            total += math.log(1 - ONSET_ODDS)
    return total
