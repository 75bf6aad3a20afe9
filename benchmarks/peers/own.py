"""avtorch's own methods: SGLD, Laplace, quadrature, conjugate draws, and Pyro's NUTS as avtorch runs it."""

from __future__ import annotations

import numpy as np
import torch

from avtorch.arrays import FloatArray
from avtorch.inference import JerkDensity, JerkStatistics, SamplerSettings, find_mode, integrate, sample
from benchmarks.peers.contract import Answer, Settings
from benchmarks.peers.problem import Windows


def density_of(windows: Windows) -> JerkDensity:
    """The default priors on the sums of every window."""
    rows = (torch.from_numpy(x) for x in (windows.a, windows.u, windows.jerk))
    return JerkDensity(JerkStatistics.from_samples(*rows))


def own_log_density(windows: Windows, z: FloatArray) -> FloatArray:
    """avtorch's log density of the first window at ``z``, ``(point, 3)`` to ``(point,)``."""
    first = density_of(windows.select(slice(0, 1)))
    return first.log_prob(torch.from_numpy(z)[:, None])[:, 0].numpy()


class OwnDensity:
    """A runner that keeps its settings and works on avtorch's own log density."""

    def __init__(self, settings: Settings) -> None:
        self.settings = settings

    def log_density(self, windows: Windows, z: FloatArray) -> FloatArray:
        return own_log_density(windows, z)


class SGLD(OwnDensity):
    """``sample`` unmodified, with default settings; any setting can be given by name."""

    def run(self, windows: Windows, seed: int) -> Answer:
        settings, generator = SamplerSettings(**self.settings), torch.Generator().manual_seed(seed)
        return Answer(sample(density_of(windows), settings, generator=generator).draws.numpy())


class Laplace(OwnDensity):
    """The mode and the normal of its curvature in the log parameters, hence log-normal moments. No draws."""

    def run(self, windows: Windows, seed: int) -> Answer:
        mode = find_mode(density_of(windows))
        variance = mode.covariance.diagonal(dim1=-2, dim2=-1)
        mean = (mode.z + 0.5 * variance).exp()
        return Answer(mean=mean.numpy(), sd=(mean * torch.expm1(variance).sqrt()).numpy())


class Quadrature(OwnDensity):
    """The truth: quadrature with default nodes."""

    def run(self, windows: Windows, seed: int) -> Answer:
        found = integrate(density_of(windows), **self.settings)
        return Answer(mean=found.mean.numpy(), sd=found.sd.numpy())


class PyroNUTS(OwnDensity):
    """Pyro's NUTS as avtorch runs it (`avtorch.inference.nuts`): dense mass matrix, chains from the Laplace
    approximation. Settings: chains, warmup, draws, as there."""

    def __init__(self, settings: Settings) -> None:
        from avtorch.inference import nuts  # the import of Pyro counts as the runner's

        super().__init__(settings)
        self.pyro = nuts

    def log_density(self, windows: Windows, z: FloatArray) -> FloatArray:
        model = self.pyro.PyroModel(density_of(windows.select(slice(0, 1))))
        return np.array([float(model.log_prob(torch.from_numpy(x))) for x in z])

    def run(self, windows: Windows, seed: int) -> Answer:
        return Answer(self.pyro.nuts(density_of(windows), window=0, seed=seed, **self.settings).draws.numpy())
