r"""The posterior's mode (paper, Eq. 4) and its curvature there, for all windows at once, by Newton's method.

For potentials of exponential form (:mod:`avtorch.inference.density`) gradient and Hessian are in closed form,

.. math::
    \nabla U = l + Q (z - m) + E^\top (e \circ C e) + a e^z + s e^{2z}, \qquad
    \nabla^2 U = Q + E^\top (\mathrm{diag}(e)\, C\, \mathrm{diag}(e) + \mathrm{diag}(e \circ C e)) E
                 + \mathrm{diag}(a e^z + 2 s e^{2z})

The search is in NumPy: for a window or two, as a live watch has them, the calls are all that it costs, and a call of
NumPy's takes a quarter of the time of one of torch's.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from avtorch.arrays import Bool, BoolArray, Float, FloatArray, Int
from avtorch.inference.density import Density, ExponentialForm, exponential_form, score_of

Expansion = tuple[FloatArray, FloatArray, FloatArray]
"""Potential ``(window,)``, gradient ``(window, d)`` and Hessian ``(window, d, d)``."""

FLAT = 1e-6
"""Least curvature that a step assumes, so that a flat direction does not become an endless step."""


@dataclass(frozen=True)
class Mode:
    """Mode and Laplace approximation of every window.

    Attributes:
        z: the mode, shape ``(window, parameter)``.
        scale: a triangular root of the Laplace covariance, ``(window, parameter, parameter)``: ``scale @ scale.mT`` is
            the inverse Hessian of the potential. It whitens the posterior for the sampler.
        log_prob: log density at the mode, ``(window,)``.
        converged: where the search ended at a proper maximum, ``(window,)`` bool.
    """

    z: Float[Tensor, "window parameter"]
    scale: Float[Tensor, "window parameter parameter"]
    log_prob: Float[Tensor, " window"]
    converged: Bool[Tensor, " window"]

    @property
    def covariance(self) -> Float[Tensor, "window parameter parameter"]:
        """Laplace covariance in ``z``, ``(window, parameter, parameter)``."""
        return self.scale @ self.scale.mT

    def select(self, index: Int[Tensor, " chosen"] | Bool[Tensor, " window"]) -> Mode:
        """The windows named by ``index``."""
        return Mode(self.z[index], self.scale[index], self.log_prob[index], self.converged[index])

    def refitted(self, z: Float[Tensor, "draw window parameter"]) -> Mode:
        """The same with mean and covariance of draws ``z`` ``(draw, window, parameter)``, where they are sound."""
        mean = z.mean(0)
        centred = (z - mean).permute(1, 2, 0)
        covariance = centred @ centred.mT / (len(z) - 1)
        factor, failed = torch.linalg.cholesky_ex(covariance.nan_to_num())
        sound = (failed == 0) & covariance.isfinite().flatten(1).all(-1)
        everyone = torch.arange(len(mean), device=mean.device)
        return self.replaced(everyone, Mode(mean, factor, self.log_prob, self.converged), sound)

    def replaced(self, index: Int[Tensor, " chosen"], other: Mode, where: Bool[Tensor, " chosen"]) -> Mode:
        """Centre and scale of the windows ``index`` taken from ``other`` where ``where`` is true."""
        z, scale = self.z.clone(), self.scale.clone()
        z[index[where]], scale[index[where]] = other.z[where], other.scale[where]
        return Mode(z, scale, self.log_prob, self.converged)


def find_mode(
    density: Density,
    *,
    start: Float[Tensor, "window parameter"] | None = None,
    iterations: int = 60,
    tolerance: float = 1e-8,
    from_values: bool = False,
) -> Mode:
    """Damped Newton ascent of the log density, batched over windows.

    Directions of negative curvature are turned into descent by the curvature's absolute value; a step is at most one
    log unit per parameter and is shortened until the potential falls.

    `start`: shape ``(window, parameter)``; by default ``density.initial()``. `tolerance`: end when half the Newton
    decrement, the possible further decrease of the potential, is below this in every window. 1e-8 leaves the mode
    within 1.5e-4 posterior SDs. `from_values`: take gradient and curvature from differences of the log density, all
    points of them in one call, in place of its score: for a density whose values are many times cheaper than its
    derivatives, as one may say of itself (``quick_values``).

    Example:
        >>> from avtorch.inference import find_mode
        >>> from avtorch.validation import synthetic_windows
        >>> density = synthetic_windows(2, seed=1).density
        >>> mode = find_mode(density)
        >>> bool((density.score(mode.z).abs() < 1e-3).all())  # the slope vanishes there
        True
    """
    begin = (density.initial() if start is None else start).detach()
    by_values = from_values or getattr(density, "quick_values", False)
    form = None if by_values else exponential_form(density)

    def by_differences(z: FloatArray) -> Expansion:
        place = torch.from_numpy(z).to(begin)
        found = _from_values(density, place) if by_values else _from_score(density, place)
        potential, gradient, hessian = (x.detach().double().cpu().numpy() for x in found)
        return _finite(potential, gradient, hessian)

    expand = by_differences if form is None else _of_form(form)
    z, (potential, gradient, hessian) = _ascend(expand, begin.double().cpu().numpy(), iterations, tolerance)
    eigenvalues, basis = np.linalg.eigh(hessian)
    curvature = np.maximum(np.abs(eigenvalues), FLAT)
    decrement = 0.5 * ((gradient[:, None, :] @ basis)[:, 0] ** 2 / curvature).sum(-1)
    converged = (eigenvalues > 0).all(-1) & (decrement < 1e-4) & np.isfinite(potential)
    root = basis / np.sqrt(curvature)[:, None, :]
    # its triangular form without squaring it, which would lose half the digits of a narrow posterior
    scale = torch.from_numpy(np.asarray(np.linalg.qr(root.transpose(0, 2, 1), mode="r"))).mT.contiguous()
    place, log_prob = torch.from_numpy(z).to(begin), torch.from_numpy(-potential).to(begin)
    return Mode(place, scale.to(begin), log_prob, torch.from_numpy(converged).to(begin.device))


def _ascend(
    expand: Callable[[FloatArray], Expansion], z: FloatArray, iterations: int, tolerance: float
) -> tuple[FloatArray, Expansion]:
    """Where the search from ``z`` ``(window, d)`` ends, and the expansion there."""
    damping = np.ones(len(z))
    with np.errstate(all="ignore"):  # what overflows is refused by `_finite`
        now = expand(z)
        for _ in range(iterations):
            potential, gradient, hessian = now
            eigenvalues, basis = np.linalg.eigh(hessian)
            projected = (gradient[:, None, :] @ basis)[:, 0]
            along = projected / np.maximum(np.abs(eigenvalues), FLAT)
            if bool((0.5 * (projected * along).sum(-1) < tolerance).all()):
                break
            step = -(basis @ along[..., None])[..., 0]
            step /= np.maximum(np.abs(step).max(-1, keepdims=True), 1.0)
            trial = z + damping[:, None] * step
            new = expand(trial)
            better: BoolArray = new[0] <= potential
            z = np.where(better[:, None], trial, z)
            potential = np.where(better, new[0], potential)
            gradient = np.where(better[:, None], new[1], gradient)
            now = potential, gradient, np.where(better[:, None, None], new[2], hessian)
            damping = np.where(better, np.minimum(2 * damping, 1.0), 0.25 * damping)
    return z, now


def _of_form(form: ExponentialForm) -> Callable[[FloatArray], Expansion]:
    constant, linear, center, quadratic, own_linear, own_square = (x.cpu().numpy() for x in form.terms)
    exponents, coupling = form.exponents.cpu().numpy(), form.coupling.cpu().numpy()
    diagonal = np.arange(linear.shape[-1])

    def expand(z: FloatArray) -> Expansion:
        e, own, off = np.exp(z @ exponents.T), np.exp(z), z - center
        bent = (quadratic @ off[..., None])[..., 0]
        pulled = e * (coupling @ e[..., None])[..., 0]
        first, second = own_linear * own, own_square * own * own
        potential = constant + (linear * z + 0.5 * (bent * off + pulled + second) + first).sum(-1)
        gradient = linear + bent + pulled @ exponents + first + second
        inner = coupling * (e[:, :, None] * e[:, None, :])
        inner[:, diagonal, diagonal] += pulled
        hessian = quadratic + exponents.T @ inner @ exponents
        hessian[:, diagonal, diagonal] += first + 2 * second
        return _finite(potential, gradient, hessian)

    return expand


def _finite(potential: FloatArray, gradient: FloatArray, hessian: FloatArray) -> Expansion:
    """The Hessian made symmetric; infinite, zero and the identity where one of the three is not finite."""
    hessian = 0.5 * (hessian + hessian.transpose(0, 2, 1))
    if bool(np.isfinite(potential + gradient.sum(-1) + hessian.sum((-2, -1))).all()):
        return potential, gradient, hessian
    good = np.isfinite(potential) & np.isfinite(gradient).all(-1) & np.isfinite(hessian).all((-2, -1))
    return (
        np.where(good, potential, np.inf),
        np.where(good[:, None], gradient, 0.0),
        np.where(good[:, None, None], hessian, np.eye(gradient.shape[-1])),
    )


def _from_score(density: Density, z: Tensor, spacing: float = 1e-5) -> tuple[Tensor, Tensor, Tensor]:
    """The Hessian from central differences of the exact score, good to ten digits: one call in place of d graphs."""
    d = z.shape[-1]
    shifts = spacing * torch.eye(d, dtype=z.dtype, device=z.device)
    with torch.no_grad():
        potential = -density.log_prob(z)
    around = -score_of(density, z + torch.cat([z.new_zeros(1, d), shifts, -shifts])[:, None, :])
    hessian = (around[1 : d + 1] - around[d + 1 :]) / (2 * spacing)
    return potential, around[0], hessian.movedim(0, -2)


def _from_values(density: Density, z: Tensor, spacing: float = 2e-3) -> tuple[Tensor, Tensor, Tensor]:
    """Central differences of values: ``1 + d + d²`` points in one call.

    A log likelihood of 10⁴ nats is good to 1e-8; over the spacing squared that is 2e-3 of curvature, and what is cut
    off is of relative order ``spacing²``. Both are far below the 0.4 of the widest noise prior.
    """
    d = z.shape[-1]
    axes = spacing * torch.eye(d, dtype=z.dtype, device=z.device)
    first, second = torch.triu_indices(d, d, 1, device=z.device)
    shifts = torch.cat([z.new_zeros(1, d), axes, -axes, axes[first] + axes[second]])
    shifts = torch.cat([shifts, -shifts[2 * d + 1 :]])
    with torch.no_grad():
        values = -density.log_prob(z + shifts[:, None, :])
    centre, plus, minus = values[0], values[1 : d + 1], values[d + 1 : 2 * d + 1]
    bent = plus + minus - 2 * centre
    pairs = len(first)
    both = values[2 * d + 1 : 2 * d + 1 + pairs] + values[2 * d + 1 + pairs :] - 2 * centre
    hessian = z.new_zeros(d, d, len(z))
    hessian.diagonal().copy_(bent.T)
    hessian[first, second] = hessian[second, first] = 0.5 * (both - bent[first] - bent[second])
    return centre, (plus - minus).T / (2 * spacing), hessian.movedim(-1, 0) / spacing**2
