"""Laplace: the mode and the normal of its curvature in the log parameters, hence log-normal moments. No draws."""

from __future__ import annotations

import torch

from avtorch.arrays import FloatArray
from avtorch.inference import find_mode
from benchmarks.peers.contract import Answer, Settings
from benchmarks.peers.problem import Windows
from benchmarks.peers.torch_rows import density_of, own_log_density


class Runner:
    def log_density(self, windows: Windows, z: FloatArray) -> FloatArray:
        return own_log_density(windows, z)

    def run(self, windows: Windows, seed: int) -> Answer:
        mode = find_mode(density_of(windows))
        variance = mode.covariance.diagonal(dim1=-2, dim2=-1)
        mean = (mode.z + 0.5 * variance).exp()
        return Answer(mean=mean.numpy(), sd=(mean * torch.expm1(variance).sqrt()).numpy())


def build(settings: Settings) -> Runner:
    return Runner()
