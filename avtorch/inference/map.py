r"""The posterior's mode (paper, Eq. 4) and its curvature there, for all windows at once, by Newton's method.

For potentials of exponential form (:mod:`avtorch.inference.exponential_form`) gradient and Hessian are in closed form,

.. math::
    \nabla U = l + Q z + E^\top (e \circ C e) + a e^z + s e^{2z}, \qquad
    \nabla^2 U = Q + E^\top (\mathrm{diag}(e)\, C\, \mathrm{diag}(e) + \mathrm{diag}(e \circ C e)) E
                 + \mathrm{diag}(a e^z + 2 s e^{2z})

and the search is in NumPy: for a window or two, as a live watch has them, the calls are all that it costs, and a call
of NumPy's takes a quarter of the time of one of torch's.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from avtorch.arrays import Bool, BoolArray, Float, FloatArray, Int
from avtorch.inference.density import Density, ScoredDensity, has_quick_values, has_score
from avtorch.inference.exponential_form import ExponentialForm, has_form, outdated

FLAT = 1e-6
"""Least curvature that a step assumes, so that a flat direction does not become an endless step."""

EIGEN_BATCH = 10_000
"""Matrices decomposed at once: so many pass on a graphics card, 100,000 ended in an internal error of cuSOLVER's."""


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
    from_values: bool | None = None,
) -> Mode:
    """Damped Newton ascent of the log density, batched over windows.

    Directions of negative curvature are turned into descent by the curvature's absolute value; a step is at most one
    log unit per parameter and is shortened until the potential falls.

    `start`: shape ``(window, parameter)``; by default ``density.initial()``. `tolerance`: end when half the Newton
    decrement, the possible further decrease of the potential, is below this in every window. 1e-8 leaves the mode
    within 1.5e-4 posterior SDs. `from_values`: take gradient and curvature from differences of the log density, all
    points of them in one call, in place of a graph: for a density whose values are many times cheaper than its
    derivatives, which is also the default for one that says so of itself (``quick_values``).

    Example:
        >>> from avtorch.inference import find_mode
        >>> from avtorch.validation import synthetic_windows
        >>> density = synthetic_windows(2, seed=1).density
        >>> mode = find_mode(density)
        >>> bool((density.score(mode.z).abs() < 1e-3).all())  # the slope vanishes there
        True
    """
    from_values = has_quick_values(density) if from_values is None else from_values
    z = (density.initial() if start is None else start).detach().clone()
    form = None if from_values else _form(density, z)
    if form is not None:
        z, potential, gradient, hessian = (torch.from_numpy(x) for x in _ascend(form, z, iterations, tolerance))
    else:
        z, potential, gradient, hessian = _search(density, z, iterations, tolerance, from_values)
    eigenvalues, basis = _eigh(hessian)
    decrement = 0.5 * (torch.einsum("wij,wi->wj", basis, gradient).square() / eigenvalues.abs().clamp_min(FLAT)).sum(-1)
    converged = (eigenvalues > 0).all(-1) & (decrement < 1e-4) & potential.isfinite()
    root = basis * eigenvalues.abs().clamp_min(FLAT).rsqrt().unsqueeze(-2)
    # its triangular form without squaring it, which would lose half the digits of a narrow posterior
    scale = torch.linalg.qr(root.mT, mode="r").R.mT
    return Mode(z, scale, -potential, converged)


def _form(density: Density, z: Tensor) -> ExponentialForm | None:
    """The density in closed form, where it has one and the search runs in NumPy."""
    if z.device.type != "cpu" or z.dtype != torch.float64 or not has_form(density):
        return None
    return None if outdated(density, "exponential_form") else density.exponential_form()


def _ascend(
    form: ExponentialForm, z: Float[Tensor, "window 3"], iterations: int, tolerance: float
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """The mode ``(window, 3)``, and potential ``(window,)``, gradient ``(window, 3)`` and Hessian ``(window, 3, 3)``
    there, as ``find_mode`` has them at the end of its search from ``z``."""
    expand = _Expansion(form)
    at = z.numpy().copy()
    damping = np.ones(len(at))
    with np.errstate(all="ignore"):  # what overflows is refused by `_Expansion`
        potential, gradient, hessian = expand(at)
        for _ in range(iterations):
            eigenvalues, basis = np.linalg.eigh(hessian)
            curvature = np.maximum(np.abs(eigenvalues), FLAT)
            projected = (gradient[:, None, :] @ basis)[:, 0]
            along = projected / curvature
            if bool((0.5 * (projected * along).sum(-1) < tolerance).all()):
                break
            step = -(basis @ along[..., None])[..., 0]
            step /= np.maximum(np.abs(step).max(-1, keepdims=True), 1.0)
            trial = at + damping[:, None] * step
            new = expand(trial)
            better: BoolArray = new[0] <= potential
            if bool(better.all()):
                at, (potential, gradient, hessian) = trial, new
                damping = np.minimum(2 * damping, 1.0)
                continue
            at = np.where(better[:, None], trial, at)
            potential = np.where(better, new[0], potential)
            gradient = np.where(better[:, None], new[1], gradient)
            hessian = np.where(better[:, None, None], new[2], hessian)
            damping = np.where(better, np.minimum(2 * damping, 1.0), 0.25 * damping)
    return at, potential, gradient, hessian


class _Expansion:
    """Potential, gradient and Hessian of a form at ``z`` ``(window, 3)``; infinite, zero and the identity where one of
    them is not finite."""

    def __init__(self, form: ExponentialForm) -> None:
        t = form.terms
        self.constant, self.linear, self.quadratic = t.constant.numpy(), t.linear.numpy(), t.quadratic.numpy()
        self.own_linear, self.own_square = t.own_linear.numpy(), t.own_square.numpy()
        self.exponents, self.offsets = form.exponents.numpy(), form.offsets.numpy()
        self.coupling = form.coupling.numpy()

    def __call__(self, z: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        e, own = np.exp(z @ self.exponents.T + self.offsets), np.exp(z)
        bent = (self.quadratic @ z[..., None])[..., 0]
        pulled = e * (self.coupling @ e[..., None])[..., 0]
        first, second = self.own_linear * own, self.own_square * own * own
        potential = self.constant + ((self.linear + 0.5 * bent) * z + 0.5 * pulled + first + 0.5 * second).sum(-1)
        gradient = self.linear + bent + pulled @ self.exponents + first + second
        inner = self.coupling * (e[:, :, None] * e[:, None, :])
        diagonal = np.arange(z.shape[-1])
        inner[:, diagonal, diagonal] += pulled
        hessian = self.quadratic + self.exponents.T @ inner @ self.exponents
        hessian[:, diagonal, diagonal] += first + 2 * second
        hessian = 0.5 * (hessian + hessian.transpose(0, 2, 1))
        sums = potential + gradient.sum(-1) + hessian.sum((-2, -1))
        if bool(np.isfinite(sums).all()):
            return potential, gradient, hessian
        good = np.isfinite(potential) & np.isfinite(gradient).all(-1) & np.isfinite(hessian).all((-2, -1))
        return (
            np.where(good, potential, np.inf),
            np.where(good[:, None], gradient, 0.0),
            np.where(good[:, None, None], hessian, np.eye(z.shape[-1])),
        )


def _search(
    density: Density, z: Tensor, iterations: int, tolerance: float, from_values: bool
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Where the search from ``z`` ends, and potential, gradient and Hessian there."""
    damping = torch.ones_like(z[:, 0])
    potential, gradient, hessian = _expand(density, z, from_values)
    for _ in range(iterations):
        eigenvalues, basis = _eigh(hessian)
        # the floor keeps a flat direction from becoming an endless step
        curvature = eigenvalues.abs().clamp_min(FLAT)
        projected = torch.einsum("wij,wi->wj", basis, gradient)
        decrement = 0.5 * (projected.square() / curvature).sum(-1)
        if bool((decrement < tolerance).all()):
            break
        step = -torch.einsum("wij,wj->wi", basis, projected / curvature)
        step = step / step.abs().amax(-1, keepdim=True).clamp_min(1.0)
        trial = z + damping[:, None] * step
        new_potential, new_gradient, new_hessian = _expand(density, trial, from_values)
        better = new_potential <= potential
        z = torch.where(better[:, None], trial, z)
        potential = torch.where(better, new_potential, potential)
        gradient = torch.where(better[:, None], new_gradient, gradient)
        hessian = torch.where(better[:, None, None], new_hessian, hessian)
        damping = torch.where(better, (2 * damping).clamp_max(1.0), 0.25 * damping)
    return z, potential, gradient, hessian


def _eigh(hessian: Float[Tensor, "window d d"]) -> tuple[Float[Tensor, "window d"], Float[Tensor, "window d d"]]:
    if len(hessian) <= EIGEN_BATCH:
        return torch.linalg.eigh(hessian)
    values, basis = zip(*(torch.linalg.eigh(part) for part in hessian.split(EIGEN_BATCH)), strict=True)
    return torch.cat(values), torch.cat(basis)


def _expand(
    density: Density, z: Float[Tensor, "window d"], from_values: bool
) -> tuple[Float[Tensor, " window"], Float[Tensor, "window d"], Float[Tensor, "window d d"]]:
    """Potential ``(window,)``, gradient ``(window, d)`` and Hessian ``(window, d, d)``; infinite where not defined."""
    z = z.detach()
    if from_values:
        potential, gradient, hessian = _from_values(density, z)
    elif has_score(density) and not has_quick_values(density):
        potential, gradient, hessian = _from_score(density, z)
    else:
        potential, gradient, hessian = _from_graph(density, z)
    hessian = 0.5 * (hessian + hessian.mT)
    good = potential.isfinite() & gradient.isfinite().all(-1) & hessian.isfinite().flatten(1).all(-1)
    eye = torch.eye(z.shape[-1], dtype=z.dtype, device=z.device)
    return (
        torch.where(good, potential, torch.inf),
        torch.where(good[:, None], gradient, 0.0),
        torch.where(good[:, None, None], hessian, eye),
    )


def _from_score(density: ScoredDensity, z: Tensor, spacing: float = 1e-5) -> tuple[Tensor, Tensor, Tensor]:
    """The Hessian from central differences of the exact score, good to ten digits: one call in place of d graphs."""
    d = z.shape[-1]
    shifts = spacing * torch.eye(d, dtype=z.dtype, device=z.device)
    with torch.no_grad():
        potential = -density.log_prob(z)
        around = -density.score(z + torch.cat([z.new_zeros(1, d), shifts, -shifts])[:, None, :])
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


def _from_graph(density: Density, z: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    z = z.requires_grad_()
    potential = -density.log_prob(z)
    (gradient,) = torch.autograd.grad(potential.sum(), z, create_graph=True)
    rows = []
    for i in range(z.shape[-1]):
        # a density that is linear in a parameter has no second derivative
        row = torch.autograd.grad(gradient[:, i].sum(), z, retain_graph=True)[0] if gradient.requires_grad else None
        rows.append(torch.zeros_like(z) if row is None else row)
    return potential.detach(), gradient.detach(), torch.stack(rows, -2)
