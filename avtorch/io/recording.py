"""A recording of many signals, each on a clock of its own: what readers of MDF4, bags, CAN, MAT and Excel answer.

A signal is listed before it is read, so that a file of thousands of signals costs no more than the few that are used.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from avtorch.arrays import FloatArray


@dataclass(frozen=True, eq=False)
class Channel:
    """One signal: `values` (sample,) at `time` (sample,) [s], as recorded; NaN where a value is not valid.

    `time` need not be even, nor rise throughout (a merged or damaged file); channels of one clock share the array.
    """

    name: str
    time: FloatArray
    values: FloatArray

    def __post_init__(self) -> None:
        for what, array in (("time", self.time), ("values", self.values)):
            if array.ndim != 1 or array.dtype != np.float64 or len(array) != len(self.time):
                raise ValueError(
                    f"{self.name}: {what} is {array.dtype} {array.shape}; float64 ({len(self.time)},) is needed"
                )


class Recording(Protocol):
    """An opened file of channels."""

    @property
    def source(self) -> str:
        """The file as messages name it."""
        ...

    @property
    def form(self) -> str:
        """The format in words, such as ``MDF 4.10`` or ``ROS 2 bag (MCAP)``."""
        ...

    @property
    def names(self) -> tuple[str, ...]:
        """All numeric channels, each name once, in the file's order."""
        ...

    @property
    def units(self) -> Mapping[str, str]:
        """Units by channel, as the file states them, for those that state one."""
        ...

    @property
    def remarks(self) -> tuple[str, ...]:
        """What was salvaged, left out or guessed while opening, in sentences."""
        ...

    def read(self, names: Collection[str]) -> dict[str, Channel]:
        """Channels by name. Raises `InputError` naming file and channel for one that is not there or is damaged."""
        ...
