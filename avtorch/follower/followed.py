"""A car that follows: its controller's law in front of the plant, fitted to its speed together with lag and delay.

The law's inputs are the measured signals, so that a rollout covers the plant alone. Unmodelled motion of the car feeds
back through its own sensors; the noise filter reduces it to each row's innovation. `K_L` is held at 1: it cannot be
distinguished from the law's gains.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import cast

import numpy as np
import torch

from avtorch.arrays import FloatArray
from avtorch.errors import InputError
from avtorch.follower.laws import FollowerMeasurements, HeadwayLaw
from avtorch.gap.drive_record import Record
from avtorch.gap.likelihood.hypothesis import Coordinate, Hypothesis
from avtorch.gap.simulator.effect import delay_effect, delay_key
from avtorch.gap.simulator.plant import GapPlant, plant
from avtorch.gap.simulator.simulator_input import SimulatorInput
from avtorch.io import Log

NEEDED = ("speed", "spacing", "lead_speed")


@dataclass(frozen=True, eq=False)
class Followed(Hypothesis):
    """`law` and a plant with `effects` over a record of speeds; `seen` of each drive, `begins`: its row of the log."""

    law: HeadwayLaw = field(kw_only=True)
    seen: tuple[FollowerMeasurements, ...] = field(kw_only=True, repr=False)
    begins: tuple[int, ...] = field(kw_only=True, repr=False)

    @cached_property
    def coordinates(self) -> tuple[Coordinate, ...]:
        """The law's parameters by `law.parameter`, `T_L`, and the effects'."""
        law = tuple(Coordinate(f"law.{p.name}", p, 1.0) for p in self.law.parameters)
        return law + tuple(c for c in super().coordinates if c.key != "K_L")

    def rollouts(self, z: FloatArray, onset: int | None = None, *, coarse: bool = False) -> FloatArray:
        values = self.values(z)
        law = {k.partition(".")[2]: v[:, None] for k, v in values.items() if k.startswith("law.")}
        car = {k: v for k, v in values.items() if not k.startswith("law.")} | {"K_L": torch.ones(len(z)).double()}
        out = []
        with torch.inference_mode():
            for drive, seen in zip(self.record.drives, self.seen, strict=True):
                sent = SimulatorInput(drive.time, self.law.command(law, seen), seen.speed)
                out.append(self.plant.response(sent, car).speed)
        return self._by_channel(cast(list, [_Speed(x) for x in out]), len(z), coarse)

    def row(self, counted: int) -> int:
        """The row of the log at which each `counted` row of the record begins."""
        place = self.record.place(counted)
        return self.begins[place.drive] + place.row

    def on(self, record: Record) -> Followed:
        """The same response over another record of the same drives."""
        return replace(self, record=record)


@dataclass(frozen=True)
class _Speed:
    """A response with speed as its only channel."""

    speed: torch.Tensor


def followed(log: Log, law: HeadwayLaw, *, dead_time: bool = True) -> Followed:
    """Make the response for a car-following log; `dead_time` False: the plant is the bare GLVD.

    Only its speed is a channel, as the acceleration of public recordings is that speed's derivative. Raises
    `InputError` for a log without speed, spacing and the leader's speed.
    """
    for name in NEEDED:
        if getattr(log, name) is None:
            raise InputError(f"{log.name}: has no {name}, which a follower needs (with {', '.join(NEEDED)})")
    record = Record.of(replace(log, accel=None, accel_cmd=np.zeros(log.rows)))
    whole = seen_in(log)
    rows = [cut.rows for cut in record.cuts]
    seen = tuple(FollowerMeasurements(*(x[part] for x in whole)) for part in rows)
    kinds = (delay_effect(),) if dead_time else ()
    return Followed(record, kinds, plant([]), law=law, seen=seen, begins=tuple(part.start for part in rows))


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
