"""Rollouts with an onset: the baseline before it, the whole plant from then on, started in the car's state."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from avtorch.gap.simulator.plant import GapPlant
from avtorch.gap.simulator.simulator_input import Place, Response, SimulatorInput


def rollout_from_onset(
    plant: GapPlant, without: GapPlant, drives: Sequence[SimulatorInput], values: Mapping[str, Tensor], place: Place
) -> list[Response]:
    """Responses to all drives of `without` before `place` and of `plant` from there on, both with these parameters.

    The plant's memory (a command in transit, a filter's state) starts in steady state there, the actuator in the state
    that `without` has reached. A baseline with effects of its own would lose their memory: in that case the car
    continues as if it had always been the plant, except for its speed.
    """
    base = {key: value for key, value in values.items() if key in ("T_L", "K_L")}
    drive, row = drives[place.drive], place.row
    earlier = [without.response(d, base) for d in drives[: place.drive]]
    later = [plant.response(d, values) for d in drives[place.drive + 1 :]]
    if row < 1:
        return [*earlier, plant.response(drive, values), *later]
    if row > len(drive.time) - 2:
        return [*earlier, without.response(drive, base), *later]
    if without.effects:
        before, after = without.response(drive, base), plant.response(drive, values)
        after = Response(after.accel[..., row:], after.accel_measured[..., row:], after.speed[..., row:])
    else:
        until, since = drive.cut(row)
        before = without.response(until, base)
        after = plant.response(since, values, actuator0=before.accel[..., row])
    gone_on = after.speed - after.speed[..., :1] + before.speed[..., row : row + 1]
    whole = Response(
        _joined(before.accel, after.accel, row),
        _joined(before.accel_measured, after.accel_measured, row),
        _joined(before.speed, gone_on, row),
    )
    return [*earlier, whole, *later]


def _joined(before: Tensor, after: Tensor, row: int) -> Tensor:
    columns = torch.broadcast_shapes(before.shape[:-1], after.shape[:-1])
    return torch.cat([before[..., :row].expand(*columns, -1), after.expand(*columns, -1)], -1)
