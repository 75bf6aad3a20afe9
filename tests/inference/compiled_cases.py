"""Densities that the compiled walk knows, each with each kind of prior, and a Gaussian."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from avtorch.inference import JerkDensity
from avtorch.inference.density import ExponentialForm, PotentialTerms
from avtorch.inference.priors import (
    Joint,
    LogSpaceNormal,
    QuadrantNormal,
    Switch,
    default_actuation_prior,
    default_jerk_noise_prior,
)

F64 = torch.float64


def generator(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


@dataclass
class Gaussian:
    """Three correlated parameters per window: a law of SGLD that is known in closed form."""

    precision: torch.Tensor
    names = ("x", "y", "z")

    @property
    def windows(self) -> int:
        return len(self.precision)

    def log_prob(self, z):
        return -0.5 * torch.einsum("...wi,wij,...wj->...w", z, self.precision, z)

    def score(self, z):
        return -torch.einsum("wij,...wj->...wi", self.precision, z)

    def initial(self):
        return torch.zeros(self.windows, 3, dtype=F64)

    @property
    def exponential_form(self):
        terms = PotentialTerms.of(self.windows, 3, quadratic=self.precision)
        none = torch.zeros_like(self.precision)
        return ExponentialForm(terms, torch.zeros(3, 3, dtype=F64), none)


def priors(windows: int):
    """Every kind of prior, by name, for the three parameters of so many windows."""
    g = generator(5)
    root = 0.1 * torch.randn(windows, 3, 3, generator=g, dtype=F64)
    carried = LogSpaceNormal(torch.zeros(windows, 3, dtype=F64), root @ root.mT + 0.1 * torch.eye(3, dtype=F64))
    mean = torch.tensor([0.3, 0.9], dtype=F64).expand(windows, 2)
    first = Joint(default_actuation_prior(), default_jerk_noise_prior())
    return {
        "first": first,
        "carried": carried,
        "of the paper": Joint(QuadrantNormal(mean, 0.04), default_jerk_noise_prior()),
        "some started": Switch(torch.arange(windows) % 2 == 0, first, carried),
    }


def densities(make_windows):
    statistics = make_windows(0, [0.3, 1.0, 2.0]).statistics
    return {name: JerkDensity(statistics, prior) for name, prior in priors(3).items()}


KINDS = ["first", "carried", "of the paper", "some started"]


def walk_noise(kernels, out, k0, k1):
    """The noise of a compiled walk into ``out`` ``(step, 3, window, chain)``, the first step's being what ``averaged``
    starts from."""
    lanes, chains = kernels.LANES, out.shape[3]
    each, words = np.zeros(3 * lanes), np.zeros(4 * lanes, dtype=np.uint64)
    for step, window in np.ndindex(out.shape[0], out.shape[2]):
        for chain in range(0, chains, lanes):
            kernels.normals(each, words, chain, step, window, k0, k1)
            out[step, :, window, chain : chain + lanes] = each.reshape(3, lanes)[:, : chains - chain]
