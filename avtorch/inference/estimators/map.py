"""The posterior's mode (paper, Eq. 4) with its Laplace spread, window by window: the loop without a sampler."""

from __future__ import annotations

import torch
from torch import Tensor

from avtorch.inference.belief import Summary
from avtorch.inference.density import Density
from avtorch.inference.map import find_mode
from avtorch.inference.sequential import SequentialInference

WIDEST = 3.0
"""SD of a logarithm, twice the widest prior's, above which the curvature at the mode does not describe the
posterior."""


class MaximumAPosteriori(SequentialInference):
    """The same windows, densities and priors as SGLD's loop; each posterior is replaced by a normal in the log space.

    Its mean is the mode and its covariance the inverse curvature there (Laplace), so that the belief's median is the
    mode and its draws are log-normal. Exact where the log posterior is quadratic; the long tail of a skewed one is
    lost.

    Takes the arguments of :class:`SequentialInference`; ``settings`` do not apply.
    """

    def _solve(self, density: Density) -> tuple[Summary, Tensor, Tensor, Tensor]:
        mode = find_mode(density)
        converged = mode.converged & (mode.covariance.diagonal(dim1=-2, dim2=-1).amax(-1) < WIDEST**2)
        # the others are not used; any finite covariance will do
        covariance = torch.where(
            converged[:, None, None],
            mode.covariance,
            torch.eye(mode.z.shape[-1], dtype=mode.z.dtype, device=mode.z.device),
        )
        summary = Summary.log_normal(mode.z, covariance, len(self.belief.draws), self.generator)
        return summary, mode.z, covariance, converged
