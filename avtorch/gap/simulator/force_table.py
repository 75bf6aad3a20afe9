"""What a car's force does beyond K_L u, without a name: a table over command and speed, and a resistance over speed.

Both are effects like those of the table, but no search tries them and no verdict names them: the diagnosis fits them in
free runs (`avtorch.gap.result.free_form`) and hands them back in the repaired simulator and its `plant.toml`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from avtorch.errors import InputError
from avtorch.gap.simulator.effect import Effect, EffectContext
from avtorch.gap.simulator.parameter import Domain
from avtorch.vehicle.arguments import tensor

Row = tuple[float, ...]

_LARGEST = 1e3  # of a force or a command [m/s²], or a speed [m/s]
_MOST_KNOTS = 64


@dataclass(frozen=True)
class _Rows(Domain):
    """A table: a list of lists of numbers."""

    def value(self, where: str, given: Any) -> Any:
        if not isinstance(given, list):
            raise InputError(f"{where}: found {type(given).__name__}, needs a list of lists of numbers")
        each = Domain(self.name, self.low, self.high, self.unit, most=self.most)
        return tuple(each.value(f"{where}[{i}]", row) for i, row in enumerate(given))


def _knots(name: str, unit: str) -> Domain:
    return Domain(name, -_LARGEST, _LARGEST, unit, least=2, most=_MOST_KNOTS, rising=True)


@dataclass(frozen=True)
class ForceTable(Effect):
    """A force beyond K_L u that is a table over command and speed.

    `force_mps2` [m/s²] has a row for each command of `command_mps2`, a column for each speed of `speed_mps`; linear
    between them and held outside, so that the car has the gain K_L there. It acts through the actuator's lag, on the
    command as it arrives and at the speed of that moment. Raises `InputError` where shapes differ.

    Example:
        >>> from avtorch.gap import ForceTable, plant
        >>> weak_when_fast = ForceTable((0.0, 2.0), (0.0, 30.0), ((0.0, 0.0), (0.0, -1.0)))
        >>> print(plant([weak_when_fast]).to_toml().partition("[")[2], end="")
        force_map]
        command_mps2 = [0.0, 2.0]
        speed_mps = [0.0, 30.0]
        force_mps2 = [[0.0, 0.0], [0.0, -1.0]]
    """

    command_mps2: Row = (-1.0, 1.0)
    speed_mps: Row = (0.0, 1.0)
    force_mps2: tuple[Row, ...] = ((0.0, 0.0), (0.0, 0.0))

    name = "force_map"
    place = "command"
    order = 10  # behind a dead time: the speed is that of the moment
    needs_speed = True
    meaning = "the force is a map of command and speed"
    equation = "K_L u + F(u, v)"
    parameters = ()
    settings = (
        _knots("command_mps2", "m/s²"),
        _knots("speed_mps", "m/s"),
        _Rows("force_mps2", -_LARGEST, _LARGEST, "m/s²", most=_MOST_KNOTS),
    )

    def __post_init__(self) -> None:
        shape = (len(self.force_mps2), *{len(row) for row in self.force_mps2})
        if shape != (len(self.command_mps2), len(self.speed_mps)):
            raise InputError(
                f"{self.name}.force_mps2: found {' x '.join(map(str, shape))}, needs a row for each of "
                f"{len(self.command_mps2)} commands and a column for each of {len(self.speed_mps)} speeds"
            )

    def force(self, command: Tensor, speed: Tensor) -> Tensor:
        """Force (...) [m/s²] at commands (...) [m/s²] and speeds (...) [m/s]."""
        table = torch.tensor(self.force_mps2, dtype=torch.float64)
        (i, p), (j, q) = _between(command, self.command_mps2), _between(speed, self.speed_mps)
        low = (1 - q) * table[i, j] + q * table[i, j + 1]
        high = (1 - q) * table[i + 1, j] + q * table[i + 1, j + 1]
        return (1 - p) * low + p * high

    def apply(self, x: Tensor, row: EffectContext) -> Tensor:
        return x + self.force(x, row.speed) / row.K_L


@dataclass(frozen=True)
class ResistanceCurve(Effect):
    """A force that is a curve over the speed, while the car moves.

    `force_mps2` [m/s²] at the speeds `speed_mps` [m/s], linear between them and held outside. Raises `InputError` where
    lengths differ.

    Example:
        >>> import torch
        >>> from avtorch.gap import ResistanceCurve, SimulatorInput, plant
        >>> time = torch.arange(100, dtype=torch.float64) * 0.05
        >>> rolling = SimulatorInput(time, 0 * time, speed=torch.full_like(time, 10.0))
        >>> plant([ResistanceCurve((0.0, 20.0), (0.0, -0.4))]).response(rolling).accel[-1].item()
        -0.2
    """

    speed_mps: Row = (0.0, 1.0)
    force_mps2: Row = (0.0, 0.0)

    name = "resistance_curve"
    place = "body"
    needs_speed = True
    meaning = "a force that depends on the speed"
    equation = "R(v) while moving"
    parameters = ()
    settings = (
        _knots("speed_mps", "m/s"),
        Domain("force_mps2", -_LARGEST, _LARGEST, "m/s²", least=2, most=_MOST_KNOTS),
    )

    def __post_init__(self) -> None:
        if len(self.force_mps2) != len(self.speed_mps):
            raise InputError(
                f"{self.name}.force_mps2: found {len(self.force_mps2)} numbers, needs one for each of "
                f"{len(self.speed_mps)} speeds"
            )

    def force(self, speed: Tensor) -> Tensor:
        """Force (...) [m/s²] at speeds (...) [m/s]."""
        j, q = _between(speed, self.speed_mps)
        curve = torch.tensor(self.force_mps2, dtype=torch.float64)
        return (1 - q) * curve[j] + q * curve[j + 1]

    def apply(self, x: Tensor, row: EffectContext) -> Tensor:
        return torch.where(row.speed > 0, self.force(row.speed), 0.0)


FREE_FORMS: tuple[type[Effect], ...] = (ForceTable, ResistanceCurve)
"""Effects without a name that a plant may have.

Example:
    >>> from avtorch.gap import FREE_FORMS
    >>> [kind.name for kind in FREE_FORMS]
    ['force_map', 'resistance_curve']
"""


def _between(x: Tensor, knots: Row) -> tuple[Tensor, Tensor]:
    """The knot (...) below each value, and the share (...) of the way to the next one."""
    at = tensor(knots)
    x = torch.as_tensor(x, dtype=torch.float64).clamp(at[0], at[-1])
    i = (torch.searchsorted(at, x.contiguous(), right=True) - 1).clamp(0, len(knots) - 2)
    return i, (x - at[i]) / (at[i + 1] - at[i])
