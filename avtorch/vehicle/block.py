"""The result of a run: time series by scenario, as in the car's own log."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any, TypeVar

import torch
from torch import Tensor

from avtorch.arrays import Bool, Float
from avtorch.display import Card, Displayed, Frame

if TYPE_CHECKING:
    import pandas  # pyright: ignore[reportMissingTypeStubs]

    from avtorch.io import Log

B = TypeVar("B", bound="Block")


SHOWN = {"speed": "m/s", "accel": "m/s²", "accel_cmd": "m/s²", "spacing": "m"}
"""Signals that a run shows of itself, with their units."""


@dataclass(frozen=True, repr=False)
class Block(Displayed):
    """A stretch of a run. `time` (time,) [s]; every other field (scenario, time), in a platoon (scenario, vehicle,
    time), in a replay of candidates (candidate, scenario, time).

    One row: the state at `time`, and the command sent then, which acts until the next row. `demanded` is the upper
    level's output, `accel_cmd` the lower level's after clipping, `clipped` where it is at the limits. `accel` is
    kinematic (0 while standing), `jerk` the instantaneous jerk of that row with its own noise (0 while standing, NaN
    where the plant does not give it). SI units.
    """

    time: Float[Tensor, " time"]
    accel_cmd: Float[Tensor, "*scenario time"]
    accel: Float[Tensor, "*scenario time"]
    speed: Float[Tensor, "*scenario time"]
    jerk: Float[Tensor, "*scenario time"]
    spacing: Float[Tensor, "*scenario time"]
    lead_speed: Float[Tensor, "*scenario time"]
    lead_accel: Float[Tensor, "*scenario time"]
    demanded: Float[Tensor, "*scenario time"]
    clipped: Bool[Tensor, "*scenario time"]

    def extent(self) -> str:
        """Rows, seconds and cars in words."""
        rows, dims = self.time.shape[-1], self.speed.shape[:-1]
        seconds = float(self.time[-1] - self.time[0]) if rows else 0.0
        drives = "1 drive" if dims.numel() == 1 else f"{dims.numel()} drives ({' x '.join(map(str, dims))})"
        return f"{rows} rows, {seconds:.4g} s, {drives}"

    def overview(self) -> Card:
        """Its extent, collisions, and the range of the main signals over all drives."""
        name = "Run" if type(self) is Block else type(self).__name__
        hit = int(self.collided.sum()) if self.time.shape[-1] else 0
        line = "No collision." if hit == 0 else f"{hit} of {self.collided.numel()} drives end in a collision."
        if not self.time.shape[-1]:
            return Card(f"{name}: {self.extent()}")
        signals = {signal: getattr(self, signal) for signal in SHOWN}
        table = Frame(
            {
                "signal": list(SHOWN),
                "unit": list(SHOWN.values()),
                **{how: [float(getattr(x, how)()) for x in signals.values()] for how in ("min", "mean", "max")},
            }
        )
        return Card(f"{name}: {self.extent()}", (line,), table)

    def to_dataframe(self) -> pandas.DataFrame:
        """A row a drive and sample: the drive's place, ``time`` [s] and every signal in SI units.

        The place is ``scenario``, in a platoon also ``vehicle``. Needs ``pip install 'avtorch[pandas]'``.
        """
        shape = self.speed.shape
        dims = {1: (), 2: ("scenario",), 3: ("scenario", "vehicle")}.get(len(shape), ())
        if len(dims) != len(shape) - 1:
            dims = tuple(f"dim_{i}" for i in range(len(shape) - 1))
        place = torch.meshgrid(*(torch.arange(n) for n in shape), indexing="ij")
        columns = {dim: place[i].flatten().numpy() for i, dim in enumerate(dims)}
        columns["time"] = self.time.expand(shape).flatten().numpy()
        names = [f.name for f in fields(self) if f.name != "time"]
        return Frame(columns | {name: getattr(self, name).flatten().numpy() for name in names}).to_dataframe()

    @classmethod
    def concatenate(cls: type[B], blocks: Sequence[B]) -> B:
        """Join consecutive blocks into one."""
        return cls(*(torch.cat([getattr(b, f.name) for b in blocks], -1) for f in fields(cls)))

    def __getitem__(self: B, part: slice) -> B:
        """The rows of a slice of time."""
        return type(self)(*(getattr(self, f.name)[..., part] for f in fields(self)))

    @property
    def collided(self) -> Bool[Tensor, "*scenario"]:
        """Whether the spacing was ever zero or less, (scenario,) or (scenario, vehicle)."""
        return (self.spacing <= 0).any(-1)

    def log(self, scenario: int = 0, vehicle: int = 0) -> Log:
        """One vehicle's drive as a `Log`; it ends with the row before a collision."""
        from avtorch.io import Log

        def row(x: Tensor) -> Tensor:
            return x[scenario] if x.dim() == 2 else x[scenario, vehicle]

        hit = torch.nonzero(row(self.spacing) <= 0)
        end = int(hit[0]) if len(hit) else self.time.shape[-1]
        names = ("accel_cmd", "accel", "speed", "jerk", "spacing", "lead_speed", "lead_accel")
        columns: dict[str, Any] = {name: row(getattr(self, name))[:end].numpy() for name in names}
        if torch.isnan(row(self.jerk)).any():
            del columns["jerk"]
        return Log.from_arrays(time=self.time[:end].numpy(), **columns)


class Trajectory(Block):
    """A whole run of `simulate`: a `Block` with dimensions (scenario, vehicle, time); vehicle 0 follows the leader."""
