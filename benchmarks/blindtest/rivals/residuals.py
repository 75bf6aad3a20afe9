"""A drive at the log's rate or thinned, and the residuals of a plant's response.

Thinned rows serve only a first screening. The controller has acted on the rows left out, so the command depends on
noise that the thinned log does not contain, and a fit attributes that to a second pole or a delay of the car.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from avtorch.arrays import BoolArray, FloatArray
from avtorch.errors import InputError
from avtorch.gap import GapPlant, SimulatorInput
from avtorch.io import Log

_SETTLE_S = 1.0


@dataclass(frozen=True, eq=False)
class Residuals:
    """Every n-th row of a log; the command is the mean over the rows between, which the actuator integrates.

    `measured` (channel, row): acceleration [m/s²] and gain in speed until the next row [m/s], as far as the log has
    them, named by `channels`. `valid` (row,): moving, engaged, not the last of a stretch, and past the first second of
    it. `push` (row,) [(m/s²)²]: squared steps of the command within the row. `step` [s].
    """

    drives: tuple[SimulatorInput, ...]
    channels: tuple[str, ...]
    measured: FloatArray
    valid: BoolArray
    push: FloatArray
    step: float

    @classmethod
    def of(cls, log: Log, *, rate_hz: float) -> Residuals:
        """At about `rate_hz`, or the log's rate if that is lower. Raises `InputError` for too few rows."""
        if log.accel_cmd is None:
            raise InputError(f"{log.name}: has no accel_cmd, needed to simulate a plant")
        every = max(1, round(log.rate_hz / rate_hz))
        channels = tuple(name for name in ("accel", "speed") if getattr(log, name) is not None)
        drives, measured, valid, push = [], [], [], []
        for part in log.engaged_segments():
            count = (part.stop - part.start) // every
            if count < 3:
                continue
            rows = slice(part.start, part.start + count * every)
            command = log.accel_cmd[rows].reshape(count, every)
            time = np.ascontiguousarray(log.elapsed[rows][::every])
            accel, speed = (None if x is None else x[rows][::every].copy() for x in (log.accel, log.speed))
            fit = np.asarray(log.usable[rows].reshape(count, every).all(1))
            valid.append(fit & np.append(fit[1:], False) & _after(fit, round(_SETTLE_S * log.rate_hz / every)))
            push.append((np.diff(command.ravel(), prepend=command[0, 0]) ** 2).reshape(count, every).sum(1))
            gained = None if speed is None else np.append(np.diff(speed), 0.0)
            measured.append(np.stack([x for x in (accel, gained) if x is not None]))
            drives.append(
                SimulatorInput(
                    torch.as_tensor(time),
                    torch.as_tensor(command.mean(1)),
                    None if speed is None else torch.as_tensor(speed),
                    None if accel is None else float(accel[0]),
                )
            )
        if not valid or np.concatenate(valid).sum() < 100:
            raise InputError(f"{log.name}: fewer than 100 rows in motion, needs more to diagnose")
        step = every / log.rate_hz
        return cls(
            tuple(drives), channels, np.concatenate(measured, 1), np.concatenate(valid), np.concatenate(push), step
        )

    @torch.no_grad()
    def misses(self, plant: GapPlant, values: Mapping[str, Tensor]) -> FloatArray:
        """Residuals (batch, channel, row), 0 where not valid; `values` as of `GapPlant.response`, batch first."""
        parts = []
        for drive in self.drives:
            answer = plant.response(drive, values)
            gained = answer.speed_measured.diff(dim=-1, append=answer.speed_measured[..., -1:])
            response = {"accel": answer.accel_measured, "speed": gained}
            batch = np.broadcast_shapes(*(response[name].shape for name in self.channels))
            parts.append(torch.stack([response[name].expand(batch) for name in self.channels], -2).numpy())
        missed = self.measured - np.concatenate(parts, -1)
        return np.where(self.valid, missed, 0.0)

    def forced(self, columns: FloatArray) -> FloatArray:
        """The channels' response (column, channel, row) to accelerations (column, row) [m/s²] of the body."""
        gained = np.zeros_like(columns)
        gained[:, :-1] = 0.5 * self.step * (columns[:, 1:] + columns[:, :-1])
        response = {"accel": columns, "speed": gained}
        return np.where(self.valid, np.stack([response[name] for name in self.channels], 1), 0.0)


def _after(fit: BoolArray, wait: int) -> BoolArray:
    """Rows with `wait` fit rows before them."""
    at = np.arange(len(fit))
    return at - np.maximum.accumulate(np.where(fit, -1, at)) > wait
