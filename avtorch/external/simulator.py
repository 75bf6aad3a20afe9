"""A simulator that is not avtorch's own: what it has to have, the numbers it lets one set, a plant as one; loading."""

from __future__ import annotations

import importlib
import inspect
import math
import sys
from collections.abc import Mapping
from copy import deepcopy
from dataclasses import fields, is_dataclass, replace
from inspect import getattr_static
from os import PathLike
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import torch

from avtorch.arrays import FloatArray
from avtorch.errors import InputError, listed, quoted
from avtorch.external.fmu import FmuSimulator
from avtorch.gap.simulator.plant import GapPlant


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


Values = Mapping[str, float]
Limits = Mapping[str, tuple[float, float]]
"""Lowest and highest value by parameter."""


@runtime_checkable
class Adjustable(Protocol):
    """A simulator that says which parameters it has and makes another with other values; an `FmuSimulator` is one."""

    def parameters(self) -> Mapping[str, float]: ...

    def with_parameters(self, values: Mapping[str, float], /) -> Simulator: ...


def values_of(simulator: Simulator, limits: Limits) -> dict[str, float]:
    """What the simulator has for the parameters in `limits`.

    They are those of an `Adjustable`, fields of a dataclass, or attributes of the object that are numbers. Raises
    `InputError` for a name that is none of these, limits that are no two rising numbers, and a value outside of them.
    """
    if isinstance(simulator, Adjustable):
        known = dict(simulator.parameters())
    else:
        # as they stand there: a property may not be ready before a drive begins
        found: dict[str, Any] = {n: getattr_static(simulator, n) for n in dir(simulator) if not n.startswith("_")}
        known = {n: float(x) for n, x in found.items() if isinstance(x, int | float) and not isinstance(x, bool)}
    for name, (low, high) in limits.items():
        if name not in known:
            raise InputError(
                f"adjustable: found {quoted(name)}, needs one of {listed(known) or 'no name: it has none'}"
            )
        if not (math.isfinite(low) and math.isfinite(high) and low < high):
            raise InputError(
                f"adjustable {name}: found limits {low:g} and {high:g}, needs two finite numbers that rise"
            )
        if not low <= known[name] <= high:
            raise InputError(
                f"adjustable {name}: is {known[name]:g}, needs limits that hold it, found {low:g} to {high:g}"
            )
    return {name: known[name] for name in limits}


def with_values(simulator: Simulator, values: Mapping[str, float]) -> Simulator:
    """The simulator with these parameters; the one that is given stays as it is.

    A dataclass is made anew, so that what it derives from its fields follows them; of another object it is a copy
    whose attributes are set.
    """
    if isinstance(simulator, Adjustable):
        return simulator.with_parameters(values)
    settable = {f.name for f in fields(simulator) if f.init} if is_dataclass(simulator) else set[str]()
    if is_dataclass(simulator) and not isinstance(simulator, type) and set(values) <= settable:
        return replace(simulator, **values)
    other = deepcopy(simulator)
    for name, value in values.items():
        setattr(other, name, value)
    return other


class DrivenPlant:
    """A `Simulator` that answers as `plant` does, without noise in its jerk."""

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


def load_simulator(text: str, *, mapping: str | PathLike[str] | None = None) -> Simulator:
    """The simulator called `module:name` (`package.module:Class`, `module:make`), in a file (`car.py:Car`), or an FMU.

    A class is instantiated, a function called, both without arguments; of a function, its value is the simulator.
    `mapping`: a TOML file that names an FMU's variables, see `FmuSimulator`.
    Raises `InputError` for a text of another form, a module or name that is not there, what cannot be made, or an
    object without `reset` and `step`.
    """
    if text.lower().endswith(".fmu"):
        return FmuSimulator(text, mapping=mapping)
    home, colon, name = text.rpartition(":")
    if not colon or not home or not name.isidentifier():
        raise InputError(
            f"simulator: found {quoted(text)}, needs MODULE:NAME, such as my_car:Car or path/my_car.py:Car, or an FMU"
        )
    module = _module(home)
    if not hasattr(module, name):
        raise InputError(f"simulator: {home} has no {name}")
    found = getattr(module, name)
    if inspect.isclass(found) or (callable(found) and not isinstance(found, Simulator)):
        try:
            found = found()
        except Exception as error:
            raised = f"raised {type(error).__name__} when called without arguments"
            raise InputError(f"simulator: {text} {raised}; {quoted(str(error))}") from error
    return check_methods(found, text)


def check_methods(simulator: Any, name: str) -> Simulator:
    """The simulator. Raises `InputError` for an object without `reset` and `step`."""
    if missing := " and ".join(n for n in ("reset", "step") if not callable(getattr(simulator, n, None))):
        raise InputError(f"simulator: {name} has no {missing}; needs reset(speed, accel) and step(accel_cmd, dt)")
    return simulator


def _module(home: str) -> object:
    here = str(Path.cwd())
    if home.endswith(".py"):
        path = Path(home)
        if not path.is_file():
            raise InputError(f"simulator: {home}: no such file")
        here, home = str(path.resolve().parent), path.stem
    if here not in sys.path:
        sys.path.insert(0, here)  # as `python -m` has it
    try:
        return importlib.import_module(home)
    except Exception as error:
        raise InputError(
            f"simulator: {home} could not be imported; {type(error).__name__}: {quoted(str(error))}"
        ) from error
