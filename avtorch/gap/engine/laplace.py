r"""Normal draws of a hypothesis's coordinates, as wide as the drive's own parts disagree.

    x ~ N(m, A^-1) within limits,    A = temper W W' + prior precision,    m = mode of the tempered density

with W the Jacobian in units of the noise. Where scores s_f of parts of the drive scatter more than A says, the model is
wrong there, and the covariance is widened, direction by direction, to the sandwich

    A^-1 temper^2 J A^-1,    J = sum of s_f s_f' over frames, neighbours included (Newey and West 1987), or over halves

(Huber 1967; White 1982). With halves an interval of 90 % covers what each of them alone would say.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from scipy.special import ndtr, ndtri

from avtorch.arrays import FloatArray
from avtorch.gap.engine.coordinates import INDEX
from avtorch.gap.engine.density import support
from avtorch.gap.engine.evidence import log_prior
from avtorch.gap.engine.gauss_newton import force_columns, jacobian, prior_terms, whitened_jacobian
from avtorch.gap.engine.hypothesis import Hypothesis
from avtorch.gap.engine.likelihood import whiten
from avtorch.gap.engine.priors import TEMPER

_TRIED = 64  # draws a draw before limits are met one coordinate at a time
_SWEEPS = 50


@dataclass(frozen=True, eq=False)
class Laplace:
    """Laplace's approximation of the tempered density at a hypothesis, in its coordinates `names`.

    `mean` (coordinate,), which may lie beyond `limits` (coordinate, 2); `covariance` (coordinate, coordinate) of the
    density alone; `stretch`: the linear map of deviations that makes it the widened one.
    """

    names: tuple[str, ...]
    mean: FloatArray
    covariance: FloatArray
    stretch: FloatArray
    limits: FloatArray

    @classmethod
    def of(cls, h: Hypothesis, names: Sequence[str] | None = None, temper: float = TEMPER) -> Laplace:
        """At an evaluated hypothesis; `names`: default those of `moving`."""
        names = moving(h) if names is None else list(names)
        data = h.data
        W = whitened_jacobian(h, jacobian(h, names))
        if h.force is not None:  # what a force map can do as well tells nothing: its coefficients are integrated out
            X = whitened_jacobian(h, force_columns(h))
            own: FloatArray = X @ X.T + np.eye(len(X)) / (temper * h.force.size**2)
            W = W - (W @ X.T) @ np.linalg.solve(own, X)
        A: FloatArray = temper * W @ W.T + np.diag(prior_terms(h, names)[0])
        root = _root(np.asarray(np.linalg.inv(A), np.float64))
        residual = whiten(data, h.covariance, h.residual)
        each = (W * residual).reshape(len(names), data.channel_count, data.frame_count, -1).sum((1, 3))
        x = torch.as_tensor(h.values[[INDEX[n] for n in names]]).requires_grad_()
        (slope,) = torch.autograd.grad(log_prior(h, names, x), x)
        covariance = root @ root.T
        mean = x.detach().numpy() + covariance @ (temper * each.sum(1) + slope.numpy())
        stretch = np.eye(len(names))
        for scatter in (_of_frames(each), _of_halves(each)):
            now = stretch @ root
            size, basis = np.linalg.eigh(temper**2 * now.T @ scatter @ now)
            # in whitened coordinates: what scatters less than the density's unit variance stays
            wider = basis * np.sqrt(np.maximum(size, 1.0)) @ basis.T
            stretch = now @ wider @ np.linalg.inv(root)
        limits = np.array([support(h, n) for n in names])
        return cls(tuple(names), mean, covariance, stretch, limits)

    @cached_property
    def widened(self) -> FloatArray:
        """Covariance (coordinate, coordinate) that covers the scatter of the drive's parts."""
        return self.stretch @ self.covariance @ self.stretch.T

    def draws(self, count: int, rng: np.random.Generator, *, widen: bool = True, times: float = 1.0) -> FloatArray:
        """Draws (draw, coordinate) within the limits, of `times` the standard deviation."""
        return truncated_normal(
            self.mean, times**2 * (self.widened if widen else self.covariance), self.limits, count, rng
        )

    def stretched(self, x: FloatArray) -> FloatArray:
        """Draws (..., coordinate) of the density made as wide as the widened covariance, reflected at the limits."""
        mean = x.reshape(-1, x.shape[-1]).mean(0)
        return reflected(mean + (x - mean) @ self.stretch.T, self.limits)


def moving(h: Hypothesis) -> list[str]:
    """Free coordinates but those that stand at a limit and make no difference there, as a saturation out of reach."""
    ends = [n for n in h.free if h[n] in h.limits(n)]
    idle = {n for n, d in zip(ends, jacobian(h, ends), strict=True) if not d.any()} if ends else set()
    return [n for n in h.free if n not in idle]


def truncated_normal(
    mean: FloatArray, covariance: FloatArray, limits: FloatArray, count: int, rng: np.random.Generator
) -> FloatArray:
    """Draws (draw, coordinate) of a normal within a box `limits` (coordinate, 2).

    Those inside are kept; where they are too few, Gibbs' sampler takes the coordinates one by one (Geweke 1991).
    """
    low, high = limits.T
    x = mean + rng.standard_normal((_TRIED * count, len(mean))) @ _root(covariance).T
    inside = x[((x >= low) & (x <= high)).all(1)]
    if len(inside) >= count:
        return inside[:count]
    x = np.clip(x[:count], low, high)
    precision = np.linalg.inv(covariance)
    for _ in range(_SWEEPS):
        for k, own in enumerate(np.sqrt(np.diag(precision))):
            centre = x[:, k] - (x - mean) @ precision[k] / own**2
            a, b = own * (low[k] - centre), own * (high[k] - centre)
            side = np.where(a > -b, -1.0, 1.0)  # in the lower tail, where probabilities keep their digits
            a, b = np.where(side < 0, -b, a), np.where(side < 0, -a, b)
            share = ndtr(a) + rng.random(count) * (ndtr(b) - ndtr(a))
            x[:, k] = np.clip(centre + side * np.clip(ndtri(share), a, b) / own, low[k], high[k])
    return x


def reflected(x: FloatArray, limits: FloatArray) -> FloatArray:
    """`x` (..., coordinate) folded back at `limits` (coordinate, 2) as often as it takes."""
    low, span = limits[:, 0], np.diff(limits)[:, 0]
    with np.errstate(invalid="ignore"):
        away = np.mod(x - low, 2 * span)
        folded = low + np.minimum(away, 2 * span - away)
    return np.where(np.isfinite(span), folded, x)


def _of_frames(scores: FloatArray) -> FloatArray:
    """Covariance of the total score from scores (coordinate, frame) that neighbours share."""
    s, F = scores - scores.mean(1, keepdims=True), scores.shape[1]
    lags = min(int(4 * (F / 100) ** (2 / 9)), F - 1)
    J = s @ s.T
    for lag in range(1, lags + 1):
        cross = s[:, lag:] @ s[:, :-lag].T
        J += (1 - lag / (lags + 1)) * (cross + cross.T)
    return J * F / max(F - 1, 1)


def _of_halves(scores: FloatArray) -> FloatArray:
    """The same from the difference of two halves, which knows one direction only."""
    half = scores.shape[1] // 2
    apart = scores[:, :half].sum(1) - scores[:, half:].sum(1)
    return np.outer(apart, apart)


def _root(covariance: FloatArray) -> FloatArray:
    """A root of a covariance, also where rounding made it indefinite."""
    size, basis = np.linalg.eigh(0.5 * (covariance + covariance.T))
    return basis * np.sqrt(np.maximum(size, 1e-18 * size.max()))
