r"""Newton's method for potentials of exponential form (:mod:`avtorch.inference.exponential_form`), in closed form.

.. math::
    \nabla U = l + Q z + E^\top (e \circ C e) + a e^z + s e^{2z}, \qquad
    \nabla^2 U = Q + E^\top (\mathrm{diag}(e)\, C\, \mathrm{diag}(e) + \mathrm{diag}(e \circ C e)) E
                 + \mathrm{diag}(a e^z + 2 s e^{2z})

The search is that of :func:`~avtorch.inference.map.find_mode`, in NumPy: for a window or two, as a live watch has them,
the calls are all that it costs, and a call of NumPy's takes a quarter of the time of one of torch's.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from avtorch.arrays import BoolArray, Float, FloatArray
from avtorch.inference.exponential_form import ExponentialForm

FLAT = 1e-6
"""Least curvature that a step assumes, so that a flat direction does not become an endless step."""


def ascend(
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


def as_tensors(*parts: FloatArray) -> tuple[Tensor, ...]:
    """Arrays as tensors on the same memory."""
    return tuple(torch.from_numpy(part) for part in parts)
