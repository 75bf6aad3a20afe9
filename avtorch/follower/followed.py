"""A car that follows: its controller's law in front of the plant, compared with its speed in the engine's coefficients.

The law's inputs are the measured signals, so that a rollout covers the plant alone. Unmodelled motion of the car feeds
back through its own sensors; fitted over the whole band it does not bias the loop (prediction-error identification; see
`gap.engine.likelihood`). `K_L` is held at 1: it cannot be distinguished from the law's gains. The recorder has no delay
or filter of its own here: nothing tells it from those of the car.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor

from avtorch.arrays import FloatArray
from avtorch.errors import InputError
from avtorch.follower.laws import FollowerMeasurements, HeadwayLaw
from avtorch.gap.engine.drive_data import DriveData
from avtorch.gap.simulator.effect import delay_effect, delay_key
from avtorch.gap.simulator.parameter import Parameter
from avtorch.gap.simulator.plant import GapPlant, plant
from avtorch.gap.simulator.simulator_input import SimulatorInput
from avtorch.io import Log

NEEDED = ("speed", "spacing", "lead_speed")
_WIDER = 2.0  # a delay can be far shorter than is typical, down to none


@dataclass(frozen=True)
class Coordinate:
    """One coordinate of a fit, standard normal a priori: the parameter's key, and by how much its prior is widened."""

    key: str
    parameter: Parameter
    wider: float = 1.0

    def value(self, z: FloatArray) -> Tensor:
        """The parameter at `z`, in its shape."""
        return self.parameter.constrain(torch.as_tensor(self.wider * z))

    def z_of(self, value: float) -> float:
        """The coordinate of a value, at most four standard deviations from the prior's centre."""
        z = float(self.parameter.unconstrain(torch.tensor(value, dtype=torch.float64))) / self.wider
        return float(np.clip(z, -4.0, 4.0))


@dataclass(frozen=True, eq=False)
class Followed:
    """`law`, and a plant with a dead time or without, over the speed of a log; `data`: the log in coefficients.

    `seen`: the law's inputs (row,) in each stretch of `data`.
    """

    log: Log = field(repr=False)
    law: HeadwayLaw
    plant: GapPlant
    data: DriveData = field(repr=False)
    seen: tuple[FollowerMeasurements, ...] = field(repr=False)

    @cached_property
    def coordinates(self) -> tuple[Coordinate, ...]:
        """The law's parameters by `law.parameter`, `T_L` [s], and the dead time [s]."""
        law = [Coordinate(f"law.{p.name}", p) for p in self.law.parameters]
        car = [(key, p) for key, p in self.plant.parameters().items() if key != "K_L"]
        return (*law, *(Coordinate(key, p, 1.0 if key == "T_L" else _WIDER) for key, p in car))

    @property
    def size(self) -> int:
        return len(self.coordinates)

    @property
    def begins(self) -> tuple[int, ...]:
        """The row of the log at which each stretch begins."""
        return tuple(self.data.source[self.data.bounds[:-1]].tolist())

    @property
    def seconds(self) -> float:
        """Time that the car follows [s], in stretches that are long enough."""
        return len(self.data.time) * self.data.dt

    def values(self, z: FloatArray) -> dict[str, Tensor]:
        """Values (column,) by key, for `z` (column, coordinate)."""
        return {c.key: c.value(z[:, i]) for i, c in enumerate(self.coordinates)}

    def z_of(self, values: Mapping[str, float]) -> FloatArray:
        """Coordinates (coordinate,) for values by key; missing ones are at their prior's centre."""
        return np.array([c.z_of(values[c.key]) if c.key in values else 0.0 for c in self.coordinates])

    def residual(self, z: FloatArray) -> FloatArray:
        """Measured less simulated coefficients of the differenced speed, (column, frame, bin)."""
        values, data = self.values(z), self.data
        law = {k.partition(".")[2]: v[:, None] for k, v in values.items() if k.startswith("law.")}
        car = {k: v for k, v in values.items() if not k.startswith("law.")} | {"K_L": torch.ones(len(z)).double()}
        speed = np.empty((len(z), len(data.time)))
        with torch.inference_mode():
            for (i, j), seen in zip(pairwise(data.bounds.tolist()), self.seen, strict=True):
                sent = self.law.command(law, seen).expand(len(z), -1)
                drive = SimulatorInput(torch.as_tensor(_even(data.time[i:j])), sent, seen.speed)
                speed[:, i:j] = self.plant.response(drive, car).speed.numpy()
        return data.measured[0] - data.transform([data.speed_difference(data.held(v)) for v in speed])

    def on(self, log: Log) -> Followed:
        """The same law and plant over other rows."""
        return _over(log, self.law, self.plant)


def followed(log: Log, law: HeadwayLaw, *, dead_time: bool = True) -> Followed:
    """Make the response for a car-following log; `dead_time` False: the plant is the bare GLVD.

    Only its speed is a channel, as the acceleration of public recordings is that speed's derivative. Raises
    `InputError` for a log without speed, spacing and the leader's speed, or without a stretch of following that is long
    enough.
    """
    for name in NEEDED:
        if getattr(log, name) is None:
            raise InputError(f"{log.name}: has no {name}, which a follower needs (with {', '.join(NEEDED)})")
    return _over(log, law, plant([delay_effect()()] if dead_time else []))


def seen_in(log: Log) -> FollowerMeasurements:
    """The law's inputs over all rows of the log."""
    assert log.spacing is not None
    assert log.speed is not None
    assert log.lead_speed is not None
    return FollowerMeasurements(*(torch.as_tensor(x) for x in (log.spacing, log.speed, log.lead_speed)))


def car_of(values: Mapping[str, float]) -> GapPlant:
    """The plant with lag and delay as found, `K_L` 1."""
    kind, delay = delay_effect(), values.get(delay_key())
    return plant([] if delay is None else [kind.of({str(kind.shift): delay})], T_L=values["T_L"], K_L=1.0)


def _over(log: Log, law: HeadwayLaw, car: GapPlant) -> Followed:
    data = DriveData.of(replace(log, accel=None, accel_cmd=np.zeros(log.rows)))
    rows = torch.as_tensor(data.source[:, None] + np.arange(data.group))
    means = [x[rows].mean(1) for x in seen_in(log)]
    seen = tuple(FollowerMeasurements(*(x[i:j] for x in means)) for i, j in pairwise(data.bounds.tolist()))
    return Followed(log, law, car, data, seen)


def _even(time: FloatArray) -> FloatArray:
    """Time stamps, made uniform where they only jitter in their last digits."""
    even = np.linspace(time[0], time[-1], len(time))
    return even if np.abs(even - time).max() < 0.02 * (even[1] - even[0]) else time
