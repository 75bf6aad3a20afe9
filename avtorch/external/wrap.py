"""The effects that a diagnosis found, put around the simulator that lacks them.

What is added to its output is the difference between the surrogate with and without what was found: what the diagnosis
itself rolled out. That is exact for effects that commute with the simulator (a delay, a sensor, a force) or with which
its surrogate commutes as it does. Speed gains what the added acceleration integrates to; the simulator's own forces do
not learn of it.
"""

from __future__ import annotations

from avtorch.errors import InputError
from avtorch.external.simulator import DrivenPlant, Simulator, with_values
from avtorch.gap.result.diagnosis import Diagnosis
from avtorch.gap.simulator.plant import GapPlant


def wrap(simulator: Simulator, found: Diagnosis) -> Wrapped:
    """`simulator` with what `found` says that it lacks, and with the parameters of the car.

    Raises `InputError` for a diagnosis that names nothing and finds no parameter wrong, or of no external simulator.

    Example:
        >>> import numpy as np
        >>> from avtorch import ExternalSimulator, Leader, diagnose, simulate
        >>> from avtorch.external import wrap
        >>> from avtorch.gap import ConstantResistance, plant
        >>> class Mine:
        ...     def reset(self, *, speed, accel):
        ...         self.speed, self.accel = speed, accel
        ...     def step(self, accel_cmd, dt):
        ...         before = self.accel
        ...         self.accel = accel_cmd + np.exp(-dt / 0.3) * (before - accel_cmd)
        ...         self.speed += dt * (before + self.accel) / 2
        ...         return self.accel, self.speed
        >>> car = plant([ConstantResistance(0.3)], T_L=0.3, sigma=0.02)
        >>> log = simulate(Leader.default(start=30.0, duration=40.0, dt=0.05), plant=car).log()
        >>> candidates = ["constant_resistance", "dead_time"]
        >>> found = diagnose(log, baseline=ExternalSimulator(Mine), effects=candidates, pairs=False)
        >>> found.verdict.names
        ('constant_resistance',)
        >>> better = wrap(Mine(), found)
        >>> better.reset(speed=20.0, accel=0.0)
        >>> speed = [better.step(0.0, 0.05)[1] for _ in range(200)][-1]  # it slows down by itself
        >>> bool(16.5 < speed < 17.5)
        True
    """
    if found.tested is None:
        raise InputError("found: is of no external simulator; needs diagnose(logs, baseline=ExternalSimulator(...))")
    if found.plant is None and not found.tested.wrong:
        raise InputError(f"found: the verdict is {found.verdict.name}; there is nothing to put around the simulator")
    own = found.tested.surrogate
    values = {p.name: p.car.mean for p in found.tested.parameters if p.name in ("T_L", "K_L") and not p.own}
    car = own.with_values(values) if found.plant is None else found.plant
    adjusted = {p.name: p.car.mean for p in found.tested.parameters if p.own}
    if any(p.own for p in found.tested.wrong):
        simulator = with_values(simulator, adjusted)
    return Wrapped(simulator, own, car)


class Wrapped:
    """A `Simulator`: another one, and what a car (`car`) does beyond its surrogate (`own`)."""

    def __init__(self, simulator: Simulator, own: GapPlant, car: GapPlant) -> None:
        self.simulator, self._without, self._with = simulator, DrivenPlant(own), DrivenPlant(car)

    def reset(self, *, speed: float, accel: float) -> None:
        """Begin a drive, see `Simulator.reset`."""
        self.simulator.reset(speed=speed, accel=accel)
        for chain in (self._without, self._with):
            chain.reset(speed=speed, accel=accel)

    def step(self, accel_cmd: float, dt: float) -> tuple[float, float]:
        """Hold the command, see `Simulator.step`."""
        accel, speed = self.simulator.step(accel_cmd, dt)
        with_it, without = self._with.step(accel_cmd, dt), self._without.step(accel_cmd, dt)
        return accel + with_it[0] - without[0], speed + with_it[1] - without[1]
