"""Conjugate regression and importance resampling: independent draws, the limit for this likelihood.

Settings: draws and proposals of `avtorch.inference.sample_conjugate`. The effective draws counted are the lesser of
what the weights leave and of what ArviZ finds in the resampled draws.
"""

from __future__ import annotations

import torch

from avtorch.arrays import FloatArray
from avtorch.inference import sample_conjugate
from benchmarks.peers.contract import Answer, Settings
from benchmarks.peers.problem import Windows
from benchmarks.peers.torch_rows import density_of, own_log_density


class Runner:
    def __init__(self, settings: Settings) -> None:
        self.settings = settings

    def log_density(self, windows: Windows, z: FloatArray) -> FloatArray:
        return own_log_density(windows, z)

    def run(self, windows: Windows, seed: int) -> Answer:
        generator = torch.Generator().manual_seed(seed)
        found = sample_conjugate(density_of(windows), generator=generator, **self.settings)
        return Answer(found.posterior.draws.numpy(), ess=found.ess.numpy())


def build(settings: Settings) -> Runner:
    return Runner(settings)
