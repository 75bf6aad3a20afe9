"""One command of all pedals, which the plant of a fitted map takes.

    u = sum_k s_k f_k p_k

with one constant f for each pedal p [m/s² a unit], s = -1 for a brake. Where two pedals act at once their commands add.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from avtorch.errors import InputError
from avtorch.io import Log, LogSource
from avtorch.pedals.pedal_drive import PedalDrive
from avtorch.pedals.pedal_map import SIGN, inputs_of


@dataclass(frozen=True, eq=False)
class PedalCommand:
    """Constants `factors` [m/s² a unit] by pedal.

    Example:
        >>> import numpy as np
        >>> from avtorch import Log
        >>> from avtorch.pedals import PedalCommand
        >>> time = np.arange(0.0, 10.0, 0.1)
        >>> log = Log.from_arrays(time=time, throttle=np.full(100, 0.2), brake=np.zeros(100), speed=10 + np.sin(time))
        >>> PedalCommand({"throttle": 5.0, "brake": 8.0}).commanded(log).accel_cmd[0].item()
        1.0
    """

    factors: Mapping[str, float]

    @classmethod
    def of(cls, logs: LogSource | Sequence[LogSource]) -> PedalCommand:
        """The constants that tell most of the acceleration, those of `fit_pedals`. Raises `InputError` for logs without
        a pedal that moves, or without speed."""
        drive = PedalDrive.of(logs)
        if drive.is_loop:
            raise InputError("logs: found a commanded speed and no pedals, needs pedals for a command of them")
        return cls(drive.factors)

    def commanded(self, log: Log) -> Log:
        """The drive with the command of its pedals as `accel_cmd` (row,), which `PedalFit.plant` takes.

        Raises `InputError` for a log that lacks a pedal.
        """
        out = np.zeros(log.rows)
        for name, values in inputs_of(log, self.factors).items():
            out += SIGN[name] * self.factors[name] * values
        return replace(log, accel_cmd=out)
