"""Adaptive importance sampling, for posteriors too steep for gradient steps.

The first proposals come from Laplace's approximation with heavy tails, each later round from kernels around the points
with the largest weights so far. All rounds count together, each point weighted relative to the mixture of all proposals
(Cornuet et al. 2012). A round's weights are tempered as far as a few points would otherwise dominate.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.special import gammaln, logsumexp

from avtorch.arrays import FloatArray

_DEGREES = 5.0  # degrees of freedom of the proposals' t distributions
_KERNELS = 60
_CARRIED = 20.0  # effective number of points that shape the next round


def importance(
    log_prob: Callable[[FloatArray], FloatArray],
    centre: FloatArray,
    scale: FloatArray,
    *,
    rounds: int,
    size: int,
    enough: float,
    seed: int,
) -> tuple[FloatArray, FloatArray]:
    """Points (place, coordinate) and their weights (place,), which sum to one.

    `log_prob`: maps (place, coordinate) to (place,). `scale`: a triangular root of Laplace's covariance at `centre`. At
    most `rounds` rounds of `size` points, until the effective sample size reaches `enough`.
    """
    rng = np.random.default_rng(seed)
    dim = len(centre)
    proposals = [(centre[None], 1.2 * scale)]
    places, values = np.zeros((0, dim)), np.zeros(0)
    weights = np.zeros(0)
    for turn in range(rounds):
        centres, root = proposals[-1]
        tails = np.sqrt(_DEGREES / rng.chisquare(_DEGREES, size))[:, None]
        fresh = centres[rng.integers(len(centres), size=size)] + tails * (rng.standard_normal((size, dim)) @ root.T)
        found = log_prob(fresh)
        places = np.concatenate([places, fresh])
        values = np.concatenate([values, np.where(np.isfinite(found), found, -np.inf)])
        proposed = np.stack([_density(places, *p) for p in proposals])
        ratios = values - np.asarray(logsumexp(proposed, axis=0)) + np.log(len(proposals))
        weights = np.exp(ratios - logsumexp(ratios))
        if turn and effective_sample_size(weights) >= enough:
            break
        if turn + 1 < rounds:
            shape = _tempered(ratios)
            mean = shape @ places
            apart = places - mean
            covariance = (apart * shape[:, None]).T @ apart + 1e-4 * scale @ scale.T
            width = (4 / (dim + 2) / effective_sample_size(shape)) ** (1 / (dim + 4))
            kernels = places[rng.choice(len(places), _KERNELS, p=shape)]
            proposals.append((kernels, width * np.linalg.cholesky(covariance)))
    return places, weights


def effective_sample_size(weights: FloatArray) -> float:
    """Effective sample size of the weights."""
    return float(1 / np.sum(weights**2))


def _tempered(ratios: FloatArray) -> FloatArray:
    power = 1.0
    for _ in range(40):
        weights = np.exp(power * (ratios - ratios.max()))
        weights /= weights.sum()
        if effective_sample_size(weights) >= _CARRIED:
            break
        power *= 0.8
    return weights


def _density(places: FloatArray, centres: FloatArray, root: FloatArray) -> FloatArray:
    """Log density (place,) of an equal mixture of t distributions around `centres` (kernel, coordinate)."""
    dim = places.shape[1]
    whitened = np.linalg.solve(root, places.T).T[:, None] - np.linalg.solve(root, centres.T).T
    square = (whitened**2).sum(-1)
    inside = -0.5 * (_DEGREES + dim) * np.log1p(square / _DEGREES)
    norm = gammaln(0.5 * (_DEGREES + dim)) - gammaln(0.5 * _DEGREES) - 0.5 * dim * np.log(_DEGREES * np.pi)
    return logsumexp(inside, axis=1) - np.log(len(centres)) + norm - np.log(np.abs(np.diag(root))).sum()
