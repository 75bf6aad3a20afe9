"""A plant of avtorch's own driven step by step, as any other simulator is."""

from __future__ import annotations

import torch

from avtorch.gap.simulator.plant import GapPlant


class DrivenPlant:
    """A `Simulator` that answers as `plant` does, without noise in its jerk.

    Example:
        >>> from avtorch.external.driven_plant import DrivenPlant
        >>> from avtorch.gap import plant
        >>> car = DrivenPlant(plant(baseline="dead_time=0.2", T_L=0.4))
        >>> car.reset(speed=20.0, accel=0.0)
        >>> [round(car.step(1.0, 0.1)[0], 2) for _ in range(4)]  # 0.2 s late
        [0.0, 0.0, 0.22, 0.39]
    """

    def __init__(self, plant: GapPlant) -> None:
        self._plant = GapPlant(plant.effects, T_L=plant.T_L, K_L=plant.K_L, sigma=0.0)

    def reset(self, *, speed: float, accel: float) -> None:
        """Begin a drive, see `Simulator.reset`."""
        self._plant.reset()
        self._accel, self._speed = (torch.tensor([x], dtype=torch.float64) for x in (accel, speed))

    def step(self, accel_cmd: float, dt: float) -> tuple[float, float]:
        """Hold the command, see `Simulator.step`."""
        u = torch.tensor([accel_cmd], dtype=torch.float64)
        self._accel, self._speed, _ = self._plant.step(self._accel, self._speed, u, dt, torch.zeros_like(u))
        return float(self._accel), float(self._speed)
