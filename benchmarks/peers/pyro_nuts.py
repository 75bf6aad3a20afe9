"""Pyro NUTS as avtorch runs it (`avtorch.inference.nuts`): dense mass matrix, chains from the Laplace approximation.

Settings: chains, warmup, draws, as there.
"""

from __future__ import annotations

import numpy as np
import torch

from avtorch.arrays import FloatArray
from avtorch.inference.nuts import PyroModel, nuts
from benchmarks.peers.contract import Answer, Settings
from benchmarks.peers.problem import Windows
from benchmarks.peers.torch_rows import density_of


class Runner:
    def __init__(self, settings: Settings) -> None:
        self.settings = settings

    def log_density(self, windows: Windows, z: FloatArray) -> FloatArray:
        model = PyroModel(density_of(windows.select(slice(0, 1))))
        return np.array([float(model.log_prob(torch.from_numpy(x))) for x in z])

    def run(self, windows: Windows, seed: int) -> Answer:
        return Answer(nuts(density_of(windows), window=0, seed=seed, **self.settings).draws.numpy())


def build(settings: Settings) -> Runner:
    return Runner(settings)
