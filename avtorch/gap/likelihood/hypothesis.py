"""A hypothesis: a plant with some effects, its fit coordinates, and its residuals on a record.

Coordinates `z` are standard normal a priori. An effect whose size can reach its neutral value may be far weaker than
typical, so the prior of sizes is twice as wide here as the table's range.

With an `onset`, a row number, the effects act from that row on, see `avtorch.gap.simulator.rollout_from_onset`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
import torch

from avtorch.arrays import Float, FloatArray
from avtorch.gap.drive_record import Record
from avtorch.gap.simulator.effect import Effect, effect_class
from avtorch.gap.simulator.integrated import Integrated
from avtorch.gap.simulator.parameter import Parameter
from avtorch.gap.simulator.plant import GapPlant, plant
from avtorch.gap.simulator.rollout_from_onset import rollout_from_onset
from avtorch.gap.simulator.simulator_input import Response, SimulatorInput

_WIDER = 2.0


@dataclass(frozen=True)
class Coordinate:
    """One coordinate of a fit: the parameter's key in the plant, and the factor by which its prior is widened."""

    key: str
    parameter: Parameter
    wider: float

    def value(self, z: Float[FloatArray, "*column"]) -> Float[torch.Tensor, "*column"]:
        return self.parameter.constrain(torch.as_tensor(self.wider * z))

    def z_of(self, value: float) -> float:
        z = float(self.parameter.unconstrain(torch.tensor(value, dtype=torch.float64))) / self.wider
        return float(np.clip(z, -4.0, 4.0))


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """A baseline with effects added, over a record."""

    record: Record
    effects: tuple[type[Effect], ...]
    baseline: GapPlant

    @classmethod
    def named(cls, record: Record, name: str, baseline: GapPlant, more: Sequence[type[Effect]] = ()) -> Hypothesis:
        """The hypothesis named `none`, an effect's name, or two joined by `+`."""
        parts = () if name == "none" else tuple(name.split("+"))
        return cls(record, tuple(effect_class(part, more) for part in parts), baseline)

    @property
    def name(self) -> str:
        return "+".join(sorted(e.name for e in self.effects)) or "none"

    @cached_property
    def plant(self) -> GapPlant:
        kept = [self.baseline.kept(kind) for kind in self.effects]
        own = [e or kind() for e, kind in zip(kept, self.effects, strict=True)]
        new = [kind.name for e, kind in zip(kept, self.effects, strict=True) if e is None]
        return plant(own, baseline=self.baseline).prepared(*self.record.segments[0], fitted=new)

    @cached_property
    def _without(self) -> GapPlant:
        return plant([], baseline=self.baseline)

    @cached_property
    def coordinates(self) -> tuple[Coordinate, ...]:
        """`T_L`, `K_L`, then the effects' parameters; vectors (a grade's profile) and the baseline's are left out."""
        own = {e.name: e for e in self.effects}
        found = []
        for key, p in self.plant.parameters().items():
            effect = key.partition(".")[0]
            if p.size > 1 or ("." in key and effect not in own):
                continue
            if effect in own and issubclass(own[effect], Integrated):
                continue
            sized = "." in key and p.neutral is not None and p.constraint != "interval"
            found.append(Coordinate(key, p, _WIDER if sized else 1.0))
        return tuple(found)

    @property
    def size(self) -> int:
        return len(self.coordinates)

    def values(self, z: Float[FloatArray, "column coordinate"]) -> dict[str, torch.Tensor]:
        """Values by key, (column,), for `z` (column, coordinate)."""
        return {c.key: c.value(z[:, i]) for i, c in enumerate(self.coordinates)}

    def held(
        self, z: Float[FloatArray, "column coordinate"], onset: int | None
    ) -> Float[FloatArray, "column coordinate"]:
        """`z` (column, coordinate); without an onset, coordinates that need one are set to their prior mean."""
        rests = [c.parameter.of_onset for c in self.coordinates]
        return np.where(rests, 0.0, z) if onset is None and any(rests) else z

    def z_of(self, values: Mapping[str, float]) -> Float[FloatArray, " coordinate"]:
        """Coordinates for values by key; missing ones are at their prior's centre."""
        return np.array([c.z_of(values[c.key]) if c.key in values else 0.0 for c in self.coordinates])

    def rollouts(
        self, z: Float[FloatArray, "column coordinate"], onset: int | None = None, *, coarse: bool = False
    ) -> Float[FloatArray, "column channel counted group"]:
        """Rollouts for `z` (column, coordinate): (column, channel, counted, group)."""
        values = self.values(self.held(z, onset))
        if onset is None:
            return self._rollouts(self.plant, values, coarse)
        drives = self.record.coarse if coarse else self.record.drives
        with torch.inference_mode():
            place = self.record.place(onset, coarse=coarse)
            responses = rollout_from_onset(self.plant, self._without, drives, values, place)
        return self._by_channel(responses, len(z), coarse)

    def baseline_rollouts(
        self, z: Float[FloatArray, "column coordinate"], *, coarse: bool = False
    ) -> Float[FloatArray, "some channel counted group"]:
        """Rollouts of the baseline alone with the `T_L` and `K_L` of `z` (column, coordinate); one if all are equal."""
        lags = z[:, [c.key in ("T_L", "K_L") for c in self.coordinates]]
        z = z[:1] if bool((lags == lags[0]).all()) else z
        values = {k: v for k, v in self.values(z).items() if k in ("T_L", "K_L")}
        return self._rollouts(self._without, values, coarse)

    def _rollouts(self, of: GapPlant, values: Mapping[str, torch.Tensor], coarse: bool = False) -> FloatArray:
        record = self.record
        with torch.inference_mode():  # no derivatives: faster recursions
            responses = [of.response(drive, values) for drive in (record.coarse if coarse else record.drives)]
        return self._by_channel(responses, max(len(v) for v in values.values()), coarse)

    def _by_channel(self, responses: Sequence[Response], columns: int, coarse: bool) -> FloatArray:
        record, parts = self.record, []
        if record.accel is not None:
            parts.append(record.at_counted_rows([r.accel_measured for r in responses], coarse=coarse))
        if record.speed is not None:
            parts.append(record.at_counted_rows([r.speed for r in responses], coarse=coarse))
        return np.stack([np.broadcast_to(p, (columns, *p.shape[-2:])) for p in parts], 1)

    def errors(
        self, z: Float[FloatArray, "column coordinate"], onset: int | None = None, *, coarse: bool = False
    ) -> Float[FloatArray, "column channel counted group"]:
        """Measurement minus rollout, (column, channel, counted, group)."""
        measured = self.record.measured
        return (measured.mean(-1, keepdims=True) if coarse else measured) - self.rollouts(z, onset, coarse=coarse)

    @property
    def integrated(self) -> type[Integrated] | None:
        """The hypothesis's effect whose coefficients are integrated out, or None."""
        return next((e for e in self.effects if issubclass(e, Integrated)), None)

    @cached_property
    def grade_columns(self) -> Float[FloatArray, "knot channel counted group"] | None:
        """Response (knot, channel, counted, group) to each coefficient of the road grade at `grade_rms` 1.

        Every segment has coefficients of its own, because its position on another segment's road is unknown.
        """
        return self._shared_columns(coarse=False)

    @cached_property
    def grade_means(self) -> Float[FloatArray, "knot channel counted 1"] | None:
        """The same of each group's mean, (knot, channel, counted, 1): within a group no slope changes."""
        return self._shared_columns(coarse=True)

    def _shared_columns(self, *, coarse: bool) -> FloatArray | None:
        """Made once for all hypotheses over this record; the record keeps them."""
        kind = self.integrated
        if kind is None or not self._roads:
            return None
        shared = self.record.shared_columns
        if (kind, coarse) not in shared:
            drives = self.record.coarse if coarse else self.record.drives
            shared[kind, coarse] = self._columns(drives, coarse=coarse)
        return shared[kind, coarse]

    def _columns(self, drives: Sequence[SimulatorInput], *, coarse: bool) -> FloatArray:
        knots = sum(road.count for road in self._roads)
        forces = []
        for drive, road, own in zip(drives, *self._places, strict=True):
            force = road.columns(_position(drive)).T
            forces.append(torch.nn.functional.pad(force, (0, 0, own.start, knots - own.stop)))
        return self._response_to_forces(drives, forces, coarse=coarse)

    def grade_response(self, coefficients: Float[FloatArray, " knot"]) -> Float[FloatArray, "channel counted group"]:
        """Response to a road grade of `coefficients` (knot,), (channel, counted, group)."""
        drives = self.record.drives
        forces = [road.force(_position(d), own)[None] for road, d, own in self._each_road(drives, coefficients)]
        return self._response_to_forces(drives, forces, coarse=False)[0]

    def _each_road(
        self, drives: Sequence[SimulatorInput], coefficients: FloatArray
    ) -> Iterator[tuple[Integrated, SimulatorInput, torch.Tensor]]:
        """Each drive with its road and that road's `coefficients` (..., knot)."""
        for drive, road, own in zip(drives, *self._places, strict=True):
            yield road, drive, torch.as_tensor(coefficients[..., own])

    @property
    def _places(self) -> tuple[list[Integrated], list[slice]]:
        """The road of each drive, and the slice of its coefficients among those of all roads."""
        ends = np.cumsum([0, *(road.count for road in self._roads)]).tolist()
        own = [slice(*part) for part in pairwise(ends)]
        numbers = self.record.segment
        return [self._roads[n] for n in numbers], [own[n] for n in numbers]

    def _response_to_forces(
        self, drives: Sequence[SimulatorInput], forces: Sequence[torch.Tensor], *, coarse: bool
    ) -> FloatArray:
        """Response of both channels to forces (column, time) of each drive, (column, channel, counted, group)."""
        accel, speed = [], []
        for drive, force in zip(drives, forces, strict=True):
            gained = torch.cumsum(0.5 * drive.dt[:-1] * (force[:, 1:] + force[:, :-1]), -1)
            hidden = drive.specific_force and self.integrated is not None and self.integrated.gravity
            accel.append(torch.zeros_like(force) if hidden else force)  # an accelerometer does not measure gravity
            speed.append(torch.cat([torch.zeros_like(force[:, :1]), gained], -1))
        channels = {"accel": accel, "speed": speed}
        return np.stack(
            [self.record.at_counted_rows(channels[name], coarse=coarse) for name in self.record.channels], 1
        )

    @cached_property
    def _roads(self) -> list[Integrated]:
        """The integrated effect, with the number of knots that each segment's road needs; empty where there is none."""
        if self.integrated is None or self.record.speed is None:
            return []
        grade = next(e for e in self.plant.effects if isinstance(e, self.integrated))
        made = []
        for drives in self.record.segments:
            positions = torch.cat([_position(drive) for drive in drives])
            made.append(grade.prepared(drives[0].time, drives[0].speed, positions))
        return made

    def grade_along(self, coefficients: Float[FloatArray, "column knot"]) -> Float[FloatArray, " column"]:
        """Root mean square grade over all drives, (column,), for coefficients (column, knot)."""
        drives = self.record.coarse
        squares = []
        for road, drive, own in self._each_road(drives, coefficients):
            # linear in the coefficients: their second moments over the road serve all columns
            each = road.magnitude(_position(drive), torch.eye(own.shape[-1], dtype=torch.float64))
            squares.append(((own @ (each @ each.T)) * own).sum(-1))
        return torch.stack(squares).sum(0).div(sum(len(d.time) for d in drives)).clamp_min(0.0).sqrt().numpy()


def _position(drive: SimulatorInput) -> torch.Tensor:
    assert drive.position is not None
    return drive.position
