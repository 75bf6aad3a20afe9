"""One command of all pedals, and the map of a plant that takes it.

    u = sum_k s_k f_k p_k,        m(p, v) = K_L u + F(u, v) + R(v)

with one constant f for each pedal p [m/s² a unit], s = -1 for a brake. Where two pedals act at once their commands add.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from avtorch.arrays import FloatArray
from avtorch.errors import InputError
from avtorch.gap.simulator.force_table import ForceTable, ResistanceCurve
from avtorch.gap.simulator.plant import GapPlant
from avtorch.io import Log, LogSource
from avtorch.pedals.pedal_drive import PedalDrive
from avtorch.pedals.pedal_map import SIGN, PedalMap, PedalTable, inputs_of

_KNOTS = 9  # of commands and of speeds, beside a plant's own


@dataclass(frozen=True, eq=False)
class PedalCommand:
    """Constants `factors` [m/s² a unit] by pedal; what was driven: `spans`, lowest and highest value by pedal, and
    `speed`, likewise [m/s].

    Example:
        >>> import numpy as np
        >>> from avtorch.gap import ForceTable, plant
        >>> from avtorch.pedals import PedalCommand
        >>> command = PedalCommand({"throttle": 5.0, "brake": 8.0}, {"throttle": (0, 1), "brake": (0, 1)}, (0.0, 30.0))
        >>> weak_when_fast = ForceTable((0.0, 5.0), (0.0, 30.0), ((0.0, 0.0), (0.0, -2.0)))
        >>> made = command.map_of(plant([weak_when_fast]))
        >>> made.accel(np.array([0.0, 30.0]), throttle=np.ones(2), brake=np.zeros(2)).round(3).tolist()
        [5.0, 3.0]
    """

    factors: Mapping[str, float]
    spans: Mapping[str, tuple[float, float]]
    speed: tuple[float, float]

    @classmethod
    def of(cls, logs: LogSource | Sequence[LogSource]) -> PedalCommand:
        """The constants that tell most of the acceleration. Raises `InputError` for logs without a pedal that moves, or
        without speed."""
        return cls.of_drive(PedalDrive.of(logs))

    @classmethod
    def of_drive(cls, drive: PedalDrive) -> PedalCommand:
        """Of drives that were read."""
        if drive.is_loop:
            raise InputError("logs: found a commanded speed and no pedals, needs pedals for a command of them")
        spans = {name: (float(x.min()), float(x.max())) for name, x in drive.pedals.items()}
        return cls(drive.factors, spans, (float(drive.speed.min()), float(drive.speed.max())))

    def commanded(self, log: Log) -> Log:
        """The drive with the command of its pedals as `accel_cmd` (row,), which `PedalFit.plant` takes.

        Raises `InputError` for a log that lacks a pedal.
        """
        out = np.zeros(log.rows)
        for name, values in inputs_of(log, self.factors).items():
            if values is None:
                raise InputError(f"{log.name}: has no {name}, which the command needs")
            out += SIGN[name] * self.factors[name] * values
        return replace(log, accel_cmd=out)

    def map_of(self, car: GapPlant) -> PedalMap:
        """The gain, force table and resistance of a plant that takes this command, with its lag and dead time."""
        forms = [e for e in car.effects if isinstance(e, ForceTable | ResistanceCurve)]
        own = [e.speed_mps for e in forms] or [np.linspace(self.speed[0], self.speed[1] + 0.1, _KNOTS)]
        v = np.unique(np.concatenate(own))
        ends = [SIGN[n] * self.factors[n] * x for n, span in self.spans.items() for x in span]
        tables = [e.command_mps2 for e in forms if isinstance(e, ForceTable)]
        u = np.unique(np.concatenate([*tables, np.linspace(min(ends), max(ends), _KNOTS), [0.0]]))
        force = float(car.K_L) * np.repeat(u[:, None], len(v), 1)
        at = [torch.as_tensor(x) for x in np.meshgrid(u, v, indexing="ij")]
        for form in forms:
            force += (form.force(*at) if isinstance(form, ForceTable) else form.force(at[1])).numpy()
        late = sum(float(e.values()[e.shift]) for e in car.effects if e.shift is not None)
        return tabulated(self, u, v, force, float(car.T_L), late)


def tabulated(
    command: PedalCommand, u: FloatArray, v: FloatArray, force: FloatArray, T_L: float, dead_time: float
) -> PedalMap:
    """The map whose `force` [m/s²] is (u, v) at commands and speeds, by pedals.

    More of a pedal never slows the car: where the force turns back, the map is halfway between the least monotone one
    above it and the greatest below.
    """
    force = 0.5 * (np.maximum.accumulate(force, 0) + np.minimum.accumulate(force[::-1], 0)[::-1])
    zero = int(np.searchsorted(u, 0.0))
    pedals = {}
    for name, factor in command.factors.items():
        order = np.argsort(SIGN[name] * u)
        low, high = command.spans[name]
        at = SIGN[name] * u[order] / factor
        kept = (at >= min(low, 0.0) - 1e-9) & (at <= high + 1e-9)
        pedals[name] = PedalTable(at[kept], force[order[kept]] - force[zero])
    return PedalMap(v, force[zero], pedals, T_L, dead_time, driven=command.speed)
