"""The truth: avtorch's quadrature with default nodes."""

from __future__ import annotations

from avtorch.arrays import FloatArray
from avtorch.inference import integrate
from benchmarks.peers.contract import Answer, Settings
from benchmarks.peers.problem import Windows
from benchmarks.peers.torch_rows import density_of, own_log_density


class Runner:
    def __init__(self, settings: Settings) -> None:
        self.settings = settings

    def log_density(self, windows: Windows, z: FloatArray) -> FloatArray:
        return own_log_density(windows, z)

    def run(self, windows: Windows, seed: int) -> Answer:
        found = integrate(density_of(windows), **self.settings)
        return Answer(mean=found.mean.numpy(), sd=found.sd.numpy())


def build(settings: Settings) -> Runner:
    return Runner(settings)
