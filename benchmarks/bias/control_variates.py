"""Control variates at the mode: minibatch gradients that are exact where the posterior is (Baker et al. 2019, SGLD-CV).

A minibatch estimates the gradient at ``z`` poorly but its *difference* from the gradient at the mode well, and the
gradient at the mode is known. The remaining minibatch noise grows with the distance from the mode, not with the window.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.func import grad, vmap

from avtorch.errors import InputError
from avtorch.inference.density import SelectableDensity, SubsampledDensity, constrained
from avtorch.inference.map import Mode

#: Entries of per-point gradients made at once: bounds the memory of the one pass over a window.
CHUNK = 2**20


class ControlVariates:
    r"""The same density with a minibatch estimate of less variance; all else is the density's own.

    .. math::
        \widehat{\log p}(z) - \left[\nabla \widehat{\log p}(\hat z) - \nabla \log p(\hat z)\right] \cdot (z - \hat z)

    with both estimates from the same minibatch. The bracket has mean zero over minibatches, so the gradient stays
    unbiased; at the mode :math:`\hat z` the estimate's gradient is that of the whole window. Per-point gradients at the
    mode are taken once, at the cost of one pass over the window; a step then costs its minibatch.

    Args:
        density: the density to estimate.
        mode: where the linear term is taken; any point near the posterior's bulk will do.

    Raises:
        InputError: for a density without minibatches, or a mode of another shape.

    Example:
        >>> import torch
        >>> from avtorch.inference import JerkPoints, find_mode
        >>> from benchmarks.bias.control_variates import ControlVariates
        >>> a, u, noise = torch.randn(3, 1, 500, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
        >>> points = JerkPoints(a, u, (0.9 * u - a) / 0.5 + 0.1 * noise)
        >>> mode = find_mode(points)
        >>> z, batch = mode.z.clone().requires_grad_(), torch.arange(10)
        >>> for density in (points, ControlVariates(points, mode)):  # the gradient at the mode, from ten points
        ...     slope, = torch.autograd.grad(density.log_prob_minibatch(z, batch).sum(), z)
        ...     print(round(slope.norm().item(), -2))
        4300.0
        0.0
    """

    def __init__(self, density: SubsampledDensity, mode: Mode) -> None:
        if not isinstance(density, SubsampledDensity):
            raise InputError(
                f"density: {type(density).__name__} has no minibatch estimate, which control variates need"
            )
        expected = (density.windows, len(density.names))
        if tuple(mode.z.shape) != expected:
            raise InputError(f"mode: shape {tuple(mode.z.shape)} is not (window, parameter) = {expected}")
        self.density = density
        self.mode = mode
        self._deviation = gradients_by_point(density, mode.z)
        # the mean over single-point estimates is the full gradient, prior and all
        self._deviation -= self._deviation.mean(1, keepdim=True)

    @property
    def names(self) -> tuple[str, ...]:
        return self.density.names

    @property
    def windows(self) -> int:
        return self.density.windows

    @property
    def points(self) -> int:
        return self.density.points

    def log_prob(self, z: Tensor) -> Tensor:
        return self.density.log_prob(z)

    def log_prob_minibatch(self, z: Tensor, index: Tensor) -> Tensor:
        """Unbiased in gradient over minibatches; see the class. ``z``: ``(..., window, parameter)``."""
        linear = ((z - self.mode.z) * self._deviation[:, index].mean(1)).sum(-1)
        return self.density.log_prob_minibatch(z, index) - linear

    def initial(self) -> Tensor:
        return self.density.initial()

    def constrain(self, z: Tensor) -> Tensor:
        return constrained(self.density, z)

    def select(self, index: Tensor) -> ControlVariates:
        """The windows named by ``index``; the gradients at their modes are reused."""
        if not isinstance(self.density, SelectableDensity):
            raise InputError(f"density: the windows of {type(self.density).__name__} cannot be taken apart")
        chosen = object.__new__(ControlVariates)
        chosen.density = self.density.select(index)
        chosen.mode = self.mode.select(index)
        chosen._deviation = self._deviation[index]
        return chosen


def gradients_by_point(density: SubsampledDensity, z: Tensor) -> Tensor:
    """Gradient at ``z`` of the estimate that each point alone would give, ``(window, point, parameter)``."""

    def estimate(place: Tensor, index: Tensor) -> Tensor:
        return density.log_prob_minibatch(place, index).sum()

    by_point = vmap(grad(estimate), in_dims=(None, 0), out_dims=1, chunk_size=max(1, CHUNK // z.numel()))
    return by_point(z.detach(), torch.arange(density.points, device=z.device)[:, None])
