"""What a robust fit asks of a model: effects on a plant, or a user's simulator taken for linear."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

from avtorch.arrays import FloatArray
from avtorch.gap.budget.analysis_record import AnalysisRecord


class FittedModel(Protocol):
    """A model of `record` with coordinates (size,) in prior standard deviations, between `low` and `high` (size,).

    `index`: which of them each parameter has.
    """

    @property
    def record(self) -> AnalysisRecord: ...
    @property
    def index(self) -> Mapping[str, slice]: ...
    @property
    def low(self) -> FloatArray: ...
    @property
    def high(self) -> FloatArray: ...
    @property
    def size(self) -> int: ...

    def simulate(self, z: FloatArray) -> FloatArray:
        """Channels (..., channel, row) [m/s²] at coordinates `z` (..., size)."""
        ...

    def traded(self, z: FloatArray) -> FloatArray:
        """Other places (start, size) that explain about the same, to be tried as well."""
        ...

    def named(self, z: FloatArray) -> Mapping[str, FloatArray]:
        """Parameters by name at coordinates `z` (size,)."""
        ...
