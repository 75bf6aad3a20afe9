"""The thirteen constants by penalised maximum likelihood of the cases' truths.

A case's probability is that of a named candidate, `(1 - P(unknown)) * share`, or `P(unknown)`. Its logarithm is a sum
of two: one of the eight constants of `odds.relative`, over the cases with a named truth, and a logistic regression of
`unknown` over all. The first determines the favourite in the second, by a step function of zero slope, so fitting one
after the other maximises both.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields

import numpy as np
from scipy.optimize import minimize

from avtorch.arrays import BoolArray, FloatArray
from avtorch.errors import InputError
from avtorch.gap.selection import model_probabilities as odds
from avtorch.gap.selection.calibration import Odds, UnknownWeights
from benchmarks.fit_calibration.cases import KeptCase

PRIORS: Mapping[str, tuple[float, float]] = {
    "effect": (4.0, 0.5),
    "second": (np.log(5.0), 1.0),
    "second_share": (np.log(0.3), 1.0),
    "second_by_chance": (np.log(5.0), 1.0),
    "second_by_chance_share": (np.log(0.3), 1.0),
    "unit": (np.log(2.0), 1.0),
    "unit_share": (np.log(0.2), 1.0),
    "power": (np.log(2.0), 0.7),
}
"""Normal, of the logarithm (mean, sd), but for `effect` [nats], which is held near 4 so that a car without any effect
rarely gets one named. The others are wide: a factor of three either way."""
WEIGHT_SD = 2.0
"""Of the weights of `unknown`, normal about 0. Their regressors are of the order of 1."""
MISSED = 1e-3
"""Share of truths without a candidate: a single case in which the search missed the truth must not determine a
constant."""

_FAR = 5.0  # prior sds at which a constant is held
_TURNS, _ENOUGH = 5, 1e-3  # maximum rounds of the search, and the gain [nats] below which it stops


@dataclass(frozen=True, eq=False)
class Fitted:
    """The constants; `z` (13,): their coordinates, logarithms but for `effect` and the weights; `covariance` of `z`.

    By the curvature at the best place: too small for prices that trade places along a curved ridge.
    """

    odds: Odds
    unknown: UnknownWeights
    z: FloatArray
    covariance: FloatArray


def fit(cases: Sequence[KeptCase], weights: Mapping[str, float]) -> Fitted:
    """Fit to `cases`, each with the weight of its kind. Raises `InputError` without named and outside causes among
    them."""
    outside = np.array([case.truth == "unknown" for case in cases])
    if outside.all() or not outside.any():
        raise InputError(f"cases: found {int(outside.sum())} of {len(cases)} from outside the table, needs both kinds")
    weigh = np.array([weights[case.kind] for case in cases])
    means, sds = (np.array([PRIORS[f.name][k] for f in fields(Odds)]) for k in (0, 1))
    loss = loss_of(cases, weights)
    # in units of the prior's sds, whose curvature is 1 at least
    best = _lowest(loss, len(means))
    of_odds = np.linalg.inv(_curvature(loss, best)) * np.outer(sds, sds)
    constants = odds_at(means + sds * best)
    columns = np.array([regressors(case, constants) for case in cases])
    learnt, of_weights = logistic(columns, outside, weigh)
    covariance = np.zeros((len(best) + len(learnt),) * 2)
    covariance[: len(best), : len(best)], covariance[len(best) :, len(best) :] = of_odds, of_weights
    return Fitted(constants, UnknownWeights(*learnt.tolist()), np.concatenate([means + sds * best, learnt]), covariance)


def loss_of(cases: Sequence[KeptCase], weights: Mapping[str, float]) -> Callable[[FloatArray], float]:
    """Negative log posterior of the eight constants of the odds [nats], up to a constant.

    Its argument (8,) are their coordinates in prior sds from the prior's means.
    """
    means, sds = (np.array([PRIORS[f.name][k] for f in fields(Odds)]) for k in (0, 1))
    named = [(case, weights[case.kind]) for case in cases if case.truth != "unknown"]

    def loss(x: FloatArray) -> float:
        found = odds_at(means + sds * x)
        log_likelihood = sum(w * np.log((1 - MISSED) * _share(case, found) + MISSED) for case, w in named)
        return 0.5 * float(x @ x) - float(log_likelihood)

    return loss


def odds_at(z: FloatArray) -> Odds:
    """Constants at coordinates (8,), see `PRIORS`."""
    return Odds(float(z[0]), *np.exp(z[1:]).tolist())


def regressors(case: KeptCase, constants: Odds) -> tuple[float, ...]:
    """Regressors of `unknown` for a case, given the favourite under these constants."""
    top = odds.favourite(case.found, constants)
    return odds.signs(top, case.none, case.left[top.name])


def logistic(columns: FloatArray, outside: BoolArray, weigh: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Weights (column,) and their covariance for regressors (case, column), by Newton's steps."""
    learnt = np.zeros(columns.shape[1])
    for _ in range(100):
        chance = 1 / (1 + np.exp(-columns @ learnt))
        slope = columns.T @ (weigh * (outside - chance)) - learnt / WEIGHT_SD**2
        curvature = (columns.T * (weigh * chance * (1 - chance))) @ columns + np.eye(len(learnt)) / WEIGHT_SD**2
        step = np.linalg.solve(curvature, slope)
        # far from the maximum a full step can overshoot into a flat region
        learnt = learnt + step / max(1.0, float(np.abs(step).max()))
        if np.abs(step).max() < 1e-10:
            break
    return learnt, np.linalg.inv(curvature)


def _share(case: KeptCase, constants: Odds) -> float:
    """Probability of the truth among the named candidates; 0 where it is none of them."""
    shares = odds.relative(case.found, constants)
    return shares.get(case.truth, 0.0) / sum(shares.values())


def _lowest(loss: Callable[[FloatArray], float], size: int) -> FloatArray:
    """Minimise `loss` (size,). It has a kink wherever two candidates score the same, where gradient steps stall;
    derivative-free line searches alternate with them until neither gains."""
    x, value = np.zeros(size), np.inf
    for _ in range(_TURNS):
        for method in ("L-BFGS-B", "Powell"):
            x = minimize(loss, x, method=method, bounds=[(-_FAR, _FAR)] * size).x
        before, value = value, loss(x)
        if value > before - _ENOUGH:
            break
    return x


def _curvature(loss: Callable[[FloatArray], float], at: FloatArray) -> FloatArray:
    """Second derivatives by central differences over about one standard error, no less than the prior's own.

    A shorter step would turn a kink into curvature, a longer one would leave the parabolic region of the loss.
    """
    size = len(at)
    here, steps = loss(at), np.full(size, 0.3)
    for _ in range(3):
        moves = np.diag(steps)
        own = np.array([(loss(at + m) + loss(at - m) - 2 * here) for m in moves]) / steps**2
        steps = 1 / np.sqrt(np.maximum(own, 1.0))
    moves, square = np.diag(steps), np.empty((size, size))
    for i in range(size):
        square[i, i] = (loss(at + moves[i]) + loss(at - moves[i]) - 2 * here) / steps[i] ** 2
        for j in range(i):
            corners = (loss(at + s * moves[i] + t * moves[j]) * s * t for s in (1, -1) for t in (1, -1))
            square[i, j] = square[j, i] = sum(corners) / (4 * steps[i] * steps[j])
    values, axes = np.linalg.eigh(square)
    return axes @ np.diag(np.maximum(values, 1.0)) @ axes.T
