"""A simulator by its name: `module:name`, an object, a class or a function that makes one."""

from __future__ import annotations

import importlib
import inspect
import sys
from os import PathLike
from pathlib import Path

from avtorch.errors import InputError, quoted
from avtorch.external.fmu import FmuSimulator
from avtorch.external.simulator import Simulator


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
            what = (
                f"simulator: {text} raised {type(error).__name__} when called without arguments; {quoted(str(error))}"
            )
            raise InputError(what) from error
    if not isinstance(found, Simulator):
        missing = " and ".join(n for n in ("reset", "step") if not callable(getattr(found, n, None)))
        raise InputError(f"simulator: {text} has no {missing}; needs reset(speed, accel) and step(accel_cmd, dt)")
    return found


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
