"""A random effect as a hypothesis: its parameters as coordinates, and its change of the noise model at their values.

Its evidence comes from the likelihood under the changed noise. The kind of change depends on what `noise` returns:

- a force: a further Ornstein-Uhlenbeck process in the Kalman filter of the errors
- tails: a mixture of two normal distributions for each row of the accelerometer
- a command's variance: errors of the command that pass the actuator, row by row
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from avtorch.arrays import Float, FloatArray
from avtorch.errors import InputError
from avtorch.gap.drive_record import Record
from avtorch.gap.likelihood.hypothesis import Coordinate, Hypothesis
from avtorch.gap.simulator.effect import Effect, NoiseChange
from avtorch.gap.simulator.plant import GapPlant
from avtorch.gap.simulator.simulator_input import SimulatorInput

Form = Literal["force", "tails", "command"]

_PARTS: dict[Form, tuple[str, ...]] = {
    "force": ("force_sd", "force_time"),
    "tails": ("tail_fraction", "tail_scale"),
    "command": ("command_variance",),
}


@dataclass(frozen=True, eq=False)
class RandomLaw:
    """A random `effect`, prepared for a drive, its `coordinates` (standard normal a priori) and its noise's `form`."""

    effect: Effect
    coordinates: tuple[Coordinate, ...] = field(repr=False)
    form: Form

    @classmethod
    def of(cls, kind: type[Effect], record: Record, baseline: GapPlant) -> RandomLaw:
        """Raises `InputError` unless `noise` returns exactly one of a force, tails, or a command's variance."""
        hypothesis = Hypothesis(record, (kind,), baseline)
        effect = next(e for e in hypothesis.plant.effects if e.name == kind.name)
        own = tuple(c for c in hypothesis.coordinates if c.key.startswith(f"{kind.name}."))
        change = effect.noise(record.drives[0].command)
        parts = [] if change is None else [name for name, x in vars(change).items() if x is not None]
        form: Form | None = None
        for each, names in _PARTS.items():
            form = each if sorted(parts) == sorted(names) else form
        if form is None:
            found = " and ".join(parts) or "nothing"
            need = "force_sd and force_time, or tail_fraction and tail_scale, or command_variance"
            raise InputError(f"{kind.name}.noise: found {found}, needs {need} from a random effect under test")
        return cls(effect, own, form)

    @property
    def name(self) -> str:
        return self.effect.name

    @property
    def size(self) -> int:
        return len(self.coordinates)

    def at(self, z: Float[FloatArray, " coordinate"]) -> Effect:
        """The effect at `z` (coordinate,)."""
        each = zip(self.coordinates, z, strict=True)
        values = {c.key.partition(".")[2]: float(c.value(np.array(x))) for c, x in each}
        return self.effect.replaced(values) if values else self.effect

    def force(self, z: Float[FloatArray, " coordinate"]) -> dict[str, float]:
        """The noise model's `more_sd` [m/s²] and `more_time` [s]."""
        change = self._change(z, torch.zeros(1, dtype=torch.float64))
        sd, time = self._single("force_sd", change.force_sd), self._single("force_time", change.force_time, above=True)
        return {"more_sd": sd, "more_time": time}

    def tails(self, z: Float[FloatArray, " coordinate"]) -> tuple[float, float]:
        """`(fraction, scale)`, at most a half and in units of the accelerometer's standard deviation."""
        change = self._change(z, torch.zeros(1, dtype=torch.float64))
        fraction = self._single("tail_fraction", change.tail_fraction)
        return min(fraction, 0.5), self._single("tail_scale", change.tail_scale)

    def command_variance(
        self, z: Float[FloatArray, " coordinate"], drives: Sequence[SimulatorInput]
    ) -> Float[FloatArray, " row"]:
        """Variance [(m/s²)²] for every row of all drives, concatenated."""
        parts = []
        for drive in drives:
            variance = self._change(z, drive.command).command_variance
            assert variance is not None
            parts.append(np.broadcast_to(variance.detach().numpy(), drive.command.shape).astype(np.float64))
        whole = np.concatenate(parts)
        if not (np.isfinite(whole).all() and (whole >= 0).all()):
            raise InputError(f"{self.name}.noise: found a command_variance below 0 or not finite, needs 0 or more")
        return whole

    def _change(self, z: FloatArray, command: Tensor) -> NoiseChange:
        change = self.at(z).noise(command)
        if change is None:
            raise InputError(f"{self.name}.noise: found nothing, needs a NoiseChange at every value of its parameters")
        return change

    def _single(self, part: str, value: Tensor | float | None, *, above: bool = False) -> float:
        x = np.asarray(value.detach() if isinstance(value, Tensor) else value, dtype=object).ravel()
        number = float(x[0]) if len(x) == 1 and x[0] is not None else float("nan")
        if not (np.isfinite(number) and number >= 0 and (number > 0 or not above)):
            need = "one finite number above 0" if above else "one finite number of 0 or more"
            raise InputError(f"{self.name}.noise: found {part} {value!r}, needs {need}")
        return number
