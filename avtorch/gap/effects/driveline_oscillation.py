"""Driveline oscillation: a lightly damped mode that jerk excites."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from avtorch.gap.simulator.actuator import modes_over
from avtorch.gap.simulator.effect import Effect, EffectContext, Parameter, register
from avtorch.gap.simulator.recursion import scan_pair
from avtorch.vehicle.arguments import Number, tensor


@register
@dataclass(frozen=True)
class DrivelineOscillation(Effect):
    """A mode of the driveline that the actuator's jerk `j` excites; neutral at amplitude and quadrature 0.

    `y'' + 2 zeta omega y' + omega² y = omega j`; the car gains `amplitude y + quadrature y' / omega` [m/s²].

    A step of the actuator by 1 m/s² rings with `amplitude` [m/s²]. The phase depends on where the mode sits in the
    driveline, so a quadrature part is fitted too; the answer states the length of both. Each step holds its mean jerk,
    and the mode is integrated exactly at any damping (above 1 it decays without ringing).

    Possible are 0.3 to 15 Hz (driveline shuffle, from trucks to small cars), and a ring of twice the step at most.

    Example:
        >>> import torch
        >>> from avtorch.gap import SimulatorInput, DrivelineOscillation, plant
        >>> time = torch.arange(400, dtype=torch.float64) * 0.01
        >>> step = SimulatorInput(time, (time >= 1.0).double())
        >>> accel = plant([DrivelineOscillation(frequency_hz=2.2, amplitude=0.3)], T_L=0.1).response(step).accel
        >>> round(accel.max().item(), 1)  # the step of 1 m/s² rings
        1.1
    """

    frequency_hz: Number = 2.2
    amplitude: Number = 0.3
    quadrature: Number = 0.0
    mode_damping: Number = 0.08

    name = "driveline_oscillation"
    place = "body"
    meaning = "changes of the drive torque make the driveline ring"
    words = "the driveline rings at {frequency_hz:.2g} Hz"
    equation = "amplitude y,  y'' + 2 zeta omega y' + omega² y = omega da/dt"
    parameters = (
        Parameter("frequency_hz", "Hz", None, 1.0, 5.0, possible=(0.3, 15.0)),
        Parameter("amplitude", "-", 0.0, -0.5, 0.5, "real", possible=(-2.0, 2.0)),
        Parameter("quadrature", "-", 0.0, -0.5, 0.5, "real", reported=False, possible=(-1.0, 1.0)),
        Parameter("mode_damping", "-", None, 0.03, 0.2, reported=False, possible=(0.005, 0.35)),
    )

    def report(self, T_L: Tensor) -> dict[str, Tensor]:
        amplitude = torch.hypot(tensor(self.amplitude), tensor(self.quadrature))
        return {"frequency_hz": tensor(self.frequency_hz), "amplitude": amplitude}

    def start(self, x: Tensor, row: EffectContext) -> Any:
        zero = torch.zeros_like(x)
        return x, zero, zero, None

    def advance(self, x: Tensor, row: EffectContext, state: Any) -> tuple[Tensor, Any]:
        before, y, rate, dt = state
        if dt is not None:  # from the previous row to this one
            (m00, m01, m10, m11), (b0, b1) = self._step(dt)
            jerk = (x - before) / dt
            y, rate = m00 * y + m01 * rate + b0 * jerk, m10 * y + m11 * rate + b1 * jerk
        return self._seen(y, rate), (x, y, rate, row.dt)

    def over(self, x: Tensor, row: EffectContext) -> Tensor:
        dt = row.dt[..., :-1] if bool(row.dt.dim() and row.dt.min() != row.dt.max()) else row.dt.reshape(-1)[:1]
        matrix, (b0, b1) = self._step(dt)
        jerk = x.diff(dim=-1) / dt
        zero = torch.zeros((), dtype=x.dtype)
        y, rate = scan_pair(matrix, (b0 * jerk, b1 * jerk), (zero, zero))
        first = torch.zeros_like(y[..., :1])
        return self._seen(torch.cat([first, y], -1), torch.cat([first, rate], -1))

    def _seen(self, y: Tensor, rate: Tensor) -> Tensor:
        return tensor(self.amplitude) * y + tensor(self.quadrature) * rate

    def _step(self, dt: Tensor) -> tuple[tuple[Tensor, Tensor, Tensor, Tensor], tuple[Tensor, Tensor]]:
        """State `(y, y' / omega)` after `dt`, and the contribution of a constant jerk."""
        omega, zeta = 2 * math.pi * tensor(self.frequency_hz), tensor(self.mode_damping)
        # the actuator's formulas, valid at any damping: their second component is y' / omega²
        m00, m01, m10, m11 = modes_over(1 / omega, 2 * zeta / omega, dt)
        matrix = (m00, m01 / omega, omega * m10, m11)
        # a constant jerk has the equilibrium jerk / omega, which the state approaches
        return matrix, ((1 - matrix[0]) / omega, -matrix[2] / omega)
