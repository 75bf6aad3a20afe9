"""avtorch's SGLD unmodified: ``sample`` with default settings; any setting can be given by name."""

from __future__ import annotations

import torch

from avtorch.arrays import FloatArray
from avtorch.inference import SamplerSettings, sample
from benchmarks.peers.contract import Answer, Settings
from benchmarks.peers.problem import Windows
from benchmarks.peers.torch_rows import density_of, own_log_density


class Runner:
    def __init__(self, settings: Settings) -> None:
        self.settings = SamplerSettings(**settings)

    def log_density(self, windows: Windows, z: FloatArray) -> FloatArray:
        return own_log_density(windows, z)

    def run(self, windows: Windows, seed: int) -> Answer:
        posterior = sample(density_of(windows), self.settings, generator=torch.Generator().manual_seed(seed))
        return Answer(posterior.draws.numpy())


def build(settings: Settings) -> Runner:
    return Runner(settings)
