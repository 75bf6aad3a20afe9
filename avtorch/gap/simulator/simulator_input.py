"""A drive as the input of a plant, and the plant's response."""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from torch import Tensor

from avtorch.errors import InputError
from avtorch.vehicle.arguments import Number, checked


@dataclass(frozen=True)
class SimulatorInput:
    """Stretches without gaps: `time` (time,) [s], `command` (..., time) [m/s²] and, where measured, `speed` [m/s].

    A row's command acts from its time until the next row's. `accel0` (...) [m/s²] is the car's acceleration at the
    first row; None: the actuator is in steady state at the first command, which also acted before the first row. `dt`
    (time,) are the steps (the last one repeats), `position` (..., time) [m] the speed integrated by trapezoids from
    `position0` (...) [m] on; `uniform`: all steps are equal. `specific_force`: measured accelerations, including
    `accel0`, are an accelerometer's readings, which include every force but gravity: a road grade acts on the speed
    alone.

    Raises `InputError` for shapes that do not fit, time that does not rise, or values that are not finite.

    Example:
        >>> import torch
        >>> from avtorch.gap import SimulatorInput
        >>> time = torch.arange(100, dtype=torch.float64) * 0.05
        >>> drive = SimulatorInput(time, torch.sin(time), speed=torch.full_like(time, 20.0))
        >>> bool(drive.uniform), round(drive.position[-1].item(), 2)  # metres
        (True, 99.0)
    """

    time: Tensor
    command: Tensor
    speed: Tensor | None = None
    accel0: Number | None = None
    specific_force: bool = False
    position0: Number = 0.0
    dt: Tensor = field(init=False)
    uniform: bool = field(init=False)
    position: Tensor | None = field(init=False)

    def __post_init__(self) -> None:
        time, command = checked("time", self.time), checked("command", self.command)
        speed = None if self.speed is None else checked("speed", self.speed)
        if time.dim() != 1 or time.shape[0] < 2:
            raise InputError(f"time: found shape {tuple(time.shape)}, needs (time,) of two rows or more")
        for name, x in (("command", command), ("speed", speed)):
            if x is not None and (x.dim() == 0 or x.shape[-1] != time.shape[0]):
                raise InputError(f"{name}: found shape {tuple(x.shape)}, needs (..., {time.shape[0]})")
        steps = time.diff()
        if not bool((steps > 0).all()):
            raise InputError("time: does not rise from row to row; a drive has no gaps and does not repeat itself")
        uniform = bool((steps - steps.mean()).abs().max() <= 1e-6 * steps.mean())
        dt = (time[-1] - time[0]) / (len(time) - 1) if uniform else torch.cat([steps, steps[-1:]])
        position = None
        if speed is not None:
            rows = 0.5 * (speed[..., 1:] + speed[..., :-1]) * (dt if uniform else dt[:-1])
            start = checked("position0", self.position0, unit="m")[..., None]
            position = start + torch.cat([torch.zeros_like(speed[..., :1]), rows.cumsum(-1)], -1)
        values = {
            "time": time,
            "command": command,
            "speed": speed,
            "accel0": None if self.accel0 is None else checked("accel0", self.accel0, unit="m/s²"),
            "dt": dt.expand(time.shape),
            "uniform": uniform,
            "position": position,
        }
        for name, value in values.items():
            object.__setattr__(self, name, value)


@dataclass(frozen=True)
class Response:
    """Response of a plant over a drive, (..., time): `accel` of the car and `accel_measured` [m/s²], `speed` of the car
    and `speed_measured` [m/s].

    `speed` is the car's acceleration integrated from the first measured speed (0 where there is none). The response
    does not stop at standstill; such rows are masked.

    Example:
        >>> import torch
        >>> from avtorch.gap import SimulatorInput, SensorBias, plant
        >>> time = torch.arange(100, dtype=torch.float64) * 0.05
        >>> response = plant([SensorBias(0.12)]).response(SimulatorInput(time, 0 * time))
        >>> round((response.accel_measured - response.accel)[-1].item(), 2)
        0.12
    """

    accel: Tensor
    accel_measured: Tensor
    speed: Tensor
    speed_measured: Tensor
