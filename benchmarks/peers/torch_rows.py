"""A window's rows as avtorch's density, for the methods that are avtorch's own."""

from __future__ import annotations

import torch

from avtorch.arrays import FloatArray
from avtorch.inference import JerkDensity, JerkStatistics
from benchmarks.peers.problem import Windows


def density_of(windows: Windows) -> JerkDensity:
    """The default priors on the sums of every window."""
    rows = (torch.from_numpy(x) for x in (windows.a, windows.u, windows.jerk))
    return JerkDensity(JerkStatistics.from_samples(*rows))


def own_log_density(windows: Windows, z: FloatArray) -> FloatArray:
    """avtorch's log density of the first window at ``z``, ``(point, 3)`` to ``(point,)``."""
    first = density_of(windows.select(slice(0, 1)))
    return first.log_prob(torch.from_numpy(z)[:, None])[:, 0].numpy()
