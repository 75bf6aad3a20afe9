"""What avtorch asks of a simulator that is not its own: `reset` and `step`."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

from avtorch.arrays import FloatArray


@runtime_checkable
class Simulator(Protocol):
    """A vehicle that answers a demanded acceleration, one step at a time.

    Any object with these two methods is one; it need not know avtorch.

    Example:
        >>> from avtorch.external import Simulator
        >>> class Car:
        ...     def reset(self, *, speed: float, accel: float) -> None:
        ...         self.speed, self.accel = speed, accel
        ...     def step(self, accel_cmd: float, dt: float) -> tuple[float, float]:
        ...         self.accel += dt / 0.4 * (accel_cmd - self.accel)
        ...         self.speed += dt * self.accel
        ...         return self.accel, self.speed
        >>> isinstance(Car(), Simulator)
        True
    """

    def reset(self, *, speed: float, accel: float) -> None:
        """Begin a drive at this speed [m/s], in steady state at this acceleration [m/s²]."""
        ...

    def step(self, accel_cmd: float, dt: float) -> tuple[float, float]:
        """Hold the command [m/s²] for `dt` [s]; the acceleration [m/s²] and speed [m/s] at the end of it."""
        ...


@runtime_checkable
class WholeDrives(Protocol):
    """A simulator that also takes a drive as a whole, where many calls would be slow."""

    def whole_drive(
        self, accel_cmd: FloatArray, dt: FloatArray, *, speed: float, accel: float
    ) -> tuple[FloatArray, FloatArray]:
        """`reset`, then a step for each command (row,) [m/s²] and length (row,) [s]: accelerations (row,) [m/s²] and
        speeds (row,) [m/s] at the ends of the steps."""
        ...
