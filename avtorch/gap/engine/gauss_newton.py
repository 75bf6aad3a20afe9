"""Gauss-Newton under a noise that is integrated out: weighted least squares with the noise of the last step.

Nuisance priors are rows of their own in every least squares, so that a recorder stretched to its limits pulls back.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from avtorch.arrays import BoolArray, FloatArray
from avtorch.gap.engine.coordinates import COORDINATES, INDEX
from avtorch.gap.engine.hypothesis import Hypothesis
from avtorch.gap.engine.likelihood import band_covariance, claim_bands, claimed, log_likelihood, whiten
from avtorch.gap.engine.priors import RECORDER_DELAY_S, RECORDER_FILTER_S

_RECORDER = {
    f"{channel}_{what}": prior[channel]
    for what, prior in (("delay", RECORDER_DELAY_S), ("filter", RECORDER_FILTER_S))
    for channel in ("accel", "speed")
}
_STEPS = {"T_L": 0.01, "K_L": 0.005} | dict.fromkeys(_RECORDER, 0.004)  # of finite differences
_BASE = {"T_L": (math.log(0.3), 1.5), "K_L": (1.0, 0.5)}  # wide: only a fit without information feels them
_LATE = ("T_L", "dead_time", "sensor_lag", "speed_lag", *_RECORDER, "square_period")
_LATER = 0.1  # of the lag: a change of timing from which the columns of a force map are computed anew
_FORCE_STEP = 0.05  # of a coefficient of a force map, in the finite difference
_WIDE = 4.0  # a fit's normal prior of a size, over the scale of its Student prior


def normal_prior(name: str, neutral: float) -> tuple[float, float]:
    """Mean and standard deviation of the normal prior under which a coordinate is fitted (T_L: of its logarithm)."""
    if name in _BASE:
        return _BASE[name]
    if name in _RECORDER:
        return _RECORDER[name]
    c = COORDINATES[name]
    return (neutral, _WIDE * c.scale) if c.mean is None else (c.mean, c.scale)


def prior_terms(h: Hypothesis, names: Sequence[str]) -> tuple[FloatArray, FloatArray]:
    """Precision and pull (parameter,) of the normal priors at the hypothesis's values."""
    precision, pull = np.zeros(len(names)), np.zeros(len(names))
    for k, name in enumerate(names):
        x = h[name]
        mean, sd = normal_prior(name, h.neutral[INDEX[name]])
        if name == "T_L":
            precision[k] = x**-2
            pull[k] = -(math.log(x) - mean) / (sd * sd * x)
        else:
            precision[k] = sd**-2
            pull[k] = (mean - x) / (sd * sd)
    return precision, pull


def penalty(h: Hypothesis, names: Sequence[str]) -> float:
    """Log density of the normal priors, that of a force map among them, without constants [nats]."""
    total = 0.0
    for name in names:
        mean, sd = normal_prior(name, h.neutral[INDEX[name]])
        x = math.log(h[name]) if name == "T_L" else h[name]
        total -= 0.5 * ((x - mean) / sd) ** 2
    if h.force is not None:
        total -= 0.5 * float(h.force_coefficients @ h.force_coefficients) / h.force.size**2
    return total


def objective(h: Hypothesis) -> float:
    """What a fit maximises [nats]: log likelihood of the whole band and normal priors."""
    return h.log_likelihood + penalty(h, h.free)


def jacobian(h: Hypothesis, names: Sequence[str]) -> FloatArray:
    """Derivatives (parameter, channel, frame, bin) of an evaluated hypothesis's response."""
    onsets = h.onset_vector()
    out = np.empty((len(names), *h.predicted.shape))
    signals = None
    for k, name in enumerate(names):
        step = 0.02 * h["T_L"] if name == "T_L" else _STEPS.get(name) or COORDINATES[name].step
        i = INDEX[name]
        p = h.values.copy()
        if name in _RECORDER:  # the car moves as before, only its recorder differs
            if signals is None:
                signals = h.on_grid()
            low = p.copy()
            p[i] += step
            if name.endswith("_delay"):
                low[i] -= step
            ahead = h.data.transform(h.recorded(*signals, p))
            behind = h.predicted if low[i] == h.values[i] else h.data.transform(h.recorded(*signals, low))
            out[k] = (ahead - behind) / (p[i] - low[i])
            continue
        if p[i] + step > h.limits(name)[1]:
            step = -step
        p[i] += step
        out[k] = (h.response(p, onsets) - h.predicted) / step
    return out


def linear_priors(h: Hypothesis, names: Sequence[str]) -> tuple[FloatArray, FloatArray]:
    """Precision and pull (unknown,) of the normal priors of the parameters `names` and then of the coefficients of the
    force map, where there is one."""
    precision, pull = prior_terms(h, names)
    if h.force is None:
        return precision, pull
    tight = np.full(h.force.count, h.force.size**-2)
    return np.concatenate([precision, tight]), np.concatenate([pull, -tight * h.force_coefficients])


def linearised(h: Hypothesis, names: Sequence[str]) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Derivatives (unknown, channel, frame, bin) by the same unknowns, with precision and pull of their priors."""
    slopes = jacobian(h, names)
    if h.force is not None:
        slopes = np.concatenate([slopes, force_columns(h)])
    return slopes, *linear_priors(h, names)


def slopes_of(h: Hypothesis) -> FloatArray:
    """Derivatives (unknown, channel, frame, bin) of `linearised` by what is free. The hypothesis keeps them until its
    `jacobian` is taken away: of an hour they are larger than all else that is kept of a set."""
    if h.jacobian is None:
        h.jacobian = linearised(h, h.free)[0]
    return h.jacobian


def force_columns(h: Hypothesis) -> FloatArray:
    """Derivatives (curve, channel, frame, bin) by the coefficients of the force map, of an evaluated hypothesis.

    They are those of an earlier place as long as the response there was as late as it is now: their scale is right
    then, and least squares need no more.
    """
    assert h.force is not None
    late = np.array([h.values[INDEX[name]] for name in _LATE])
    late[-1] = math.sqrt(max(late[-1], 0.0))
    if h.force_columns is not None:
        there, columns = h.force_columns
        if np.abs(there - late).max() < _LATER * late[0] and columns.shape[1:] == h.predicted.shape:
            return columns
    moved, columns = h.copy(), np.empty((h.force.count, *h.predicted.shape))
    for k in range(h.force.count):
        moved.force_coefficients = h.force_coefficients.copy()
        moved.force_coefficients[k] += _FORCE_STEP
        columns[k] = (moved.response() - h.predicted) / _FORCE_STEP
    h.force_columns = late, columns
    return columns


def whitened_under_noise(h: Hypothesis, slopes: FloatArray, precision: FloatArray, rounds: int) -> FloatArray:
    """Derivatives in units of the noise, (unknown, coefficient), of `linearised`.

    With a force map the noise has what the response may be wrong by, all unknowns together, and this depends on the
    noise: in so many rounds both settle, and the hypothesis has the noise and its log likelihood.
    """
    W = whitened_jacobian(h, slopes)
    if h.force is None:
        return W
    for _ in range(rounds):
        unsure = np.linalg.inv(W @ W.T + np.diag(precision))
        sizes, turn = np.linalg.eigh(0.5 * (unsure + unsure.T))
        turned = np.tensordot((turn * np.sqrt(np.maximum(sizes, 0.0))).T, slopes, 1)
        h.force_spread = np.sum([band_covariance(h.data, x) for x in turned], axis=0)
        h.log_likelihood, h.covariance = log_likelihood(h.data, h.residual, h.force_spread)
        W = whitened_jacobian(h, slopes)
    return W


def whitened_jacobian(h: Hypothesis, derivatives: FloatArray) -> FloatArray:
    """Derivatives in units of the noise, (parameter, coefficient)."""
    return np.array([whiten(h.data, h.covariance, j) for j in derivatives])


def fit(h: Hypothesis, iterations: int = 8, tolerance: float = 0.05, upper: float = 1.0) -> Hypothesis:
    """The hypothesis at the maximum of `objective`, changed in place and returned; bands above `claim_hz` count with
    the weight `upper`.

    Steps are shortened by damping until they gain; a coordinate that would leave its limits stays there and the others
    are solved again. A likelihood in a delay has creases, where commands arrive with a row: on one, no step gains, and
    delays are held. Stops where a step gains less than `tolerance` [nats].
    """
    names = h.free
    at = [INDEX[n] for n in names]
    low, high = np.array([h.limits(n) for n in names]).T
    boundless = np.full(len(h.force_coefficients), np.inf)
    low, high = np.concatenate([low, -boundless]), np.concatenate([high, boundless])
    h.evaluate()
    damping, scale = 1e-3, _band_scale(h, upper)
    creased = np.array([n.endswith("_delay") or n == "dead_time" for n in names])
    creased = np.concatenate([creased, boundless < 0])
    held = np.zeros(len(creased), bool)
    for _ in range(iterations):
        slopes, precision, pull = linearised(h, names)
        W = whitened_under_noise(h, slopes, precision, 1) * scale
        H = W @ W.T
        current = _height(h, names, upper)
        g = W @ (whiten(h.data, h.covariance, h.residual) * scale) + pull
        better = None
        for _ in range(10):
            A = H + np.diag(precision + damping * np.diag(H) + 1e-12)
            new = h.copy()
            x = _within(A, g, np.concatenate([h.values[at], h.force_coefficients]), low, high, held)
            new.values[at], new.force_coefficients = x[: len(at)], x[len(at) :]
            new["T_L"] = min(max(new["T_L"], 0.4 * h["T_L"]), 2.5 * h["T_L"])
            new.evaluate()
            value = _height(new, names, upper)
            if value > current - 1e-9:
                better = new
                break
            if damping > 10.0:
                if held.any() or not creased.any():
                    break
                held, damping = creased, 1e-3
            else:
                damping = max(damping * 8, 1e-2)
        if better is None:
            break
        gain = value - current
        h.values, h.predicted, h.residual = better.values, better.predicted, better.residual
        h.force_coefficients = better.force_coefficients
        h.covariance, h.log_likelihood = better.covariance, better.log_likelihood
        damping = max(damping / 10, 1e-5)
        if gain < tolerance:
            break
    return h


def _height(h: Hypothesis, names: Sequence[str], upper: float) -> float:
    """What a fit maximises [nats]."""
    claim = 0.0 if upper == 1 else claimed(h.data, h.covariance)
    return claim + upper * (h.log_likelihood - claim) + penalty(h, names)


def _band_scale(h: Hypothesis, upper: float) -> FloatArray | float:
    """Square root of the weight of each flat coefficient."""
    if upper == 1:
        return 1.0
    bins = np.where(h.data.band_of_bin < claim_bands(h.data), 1.0, math.sqrt(upper))
    return np.broadcast_to(bins, h.predicted.shape).ravel()


def _within(
    A: FloatArray, g: FloatArray, x: FloatArray, low: FloatArray, high: FloatArray, held: BoolArray
) -> FloatArray:
    """`x` plus the step that solves `A step = g`, within limits and not along `held` coordinates: what would leave its
    limits is fixed, the rest solved again."""
    step = np.linalg.solve(A, g)
    fixed = np.zeros(len(x), bool)
    for _ in range(4):
        beyond = ((x + step < low) | (x + step > high) | held) & ~fixed
        if not beyond.any():
            break
        fixed |= beyond
        step[held] = 0.0
        step[beyond] = np.clip(x[beyond] + step[beyond], low[beyond], high[beyond]) - x[beyond]
        free = ~fixed
        if free.any():
            step[free] = np.linalg.solve(A[np.ix_(free, free)], g[free] - A[np.ix_(free, fixed)] @ step[fixed])
    return np.clip(x + step, low, high)
