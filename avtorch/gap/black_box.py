"""What a diagnosis and a comparison ask of a simulator that is not made of effects."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Protocol, runtime_checkable

from avtorch.gap.result.diagnosis import Diagnosis
from avtorch.gap.simulator.plant import GapPlant
from avtorch.io import Log


class SimulatorBesideCar(Protocol):
    """A car's drives and a simulator that is not made of effects: diagnosed by `logs` with `plant` as the baseline."""

    @property
    def logs(self) -> Sequence[Log]: ...
    @property
    def plant(self) -> GapPlant: ...
    def told(self, found: Diagnosis) -> Diagnosis: ...


@runtime_checkable
class BlackBoxSimulator(Protocol):
    """A simulator that is not made of effects; `avtorch.external.ExternalSimulator` is one."""

    def beside(self, logs: Sequence[Log], progress: Callable[[str, int, int], None] | None) -> SimulatorBesideCar: ...
