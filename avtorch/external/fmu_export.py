"""The effects that were found, as an FMU for another tool: the whole car, or what the user's simulator lacks."""

from __future__ import annotations

import json
import shutil
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING

from avtorch.errors import InputError
from avtorch.gap.simulator.around import Around
from avtorch.gap.simulator.plant import GapPlant
from avtorch.io.answers import atomic
from avtorch.io.formats.kinds import Kind, library
from avtorch.io.opening import place

if TYPE_CHECKING:
    from avtorch.gap.result.diagnosis import Diagnosis

_MADE = Kind("to be an FMU", "", "fmu", (".fmu",), "'PK', as a ZIP file")
_CAR = {"name": "avtorch_car", "description": "The whole car as avtorch found it"}
_AROUND = {"name": "avtorch_around", "description": "What a simulator of a car lacks, around that simulator"}


def write_fmu(
    found: GapPlant | Diagnosis, path: str | PathLike[str], *, around: bool = False, dt: float | None = None
) -> Path:
    """Write a plant, or the one that a diagnosis found, as an FMU (FMI 2, co-simulation); returns the file.

    The whole car: input `accel_cmd`, outputs `accel` (the measured one) and `speed`; it starts at the parameters
    `speed0` and `accel0`, takes steps of any length, and stays at rest where it would roll back.

    `around` True: the difference around the user's simulator, stepped by `dt` [s]. Inputs `accel_cmd`, `accel_sim` and
    `speed_sim`; outputs `accel_cmd_out`, which the user's simulator is to be given, and the car's `accel` and `speed`.
    The outputs follow the inputs of the same time. So, in each step: set `accel_cmd`, take `accel_cmd_out`, step the
    simulator with it, step this block, set `accel_sim` and `speed_sim`, take `accel` and `speed`. The plant's `T_L` and
    `K_L` have no say; a dead time that is no whole number of steps is given as the mean command of each step.

    The parameters of the plant and of its effects are parameters of the FMU; random effects are drawn by its parameter
    `seed`, the jerk noise is left out.

    The FMU holds the plant, a script and the libraries of PythonFMU for 64-bit Linux and Windows, but neither Python
    nor avtorch: the machine that imports it needs a Python that finds avtorch. A tool that is no Python program is
    given one on Linux by `LD_PRELOAD=.../libpython3.11.so`, on Windows by the `PATH`, and avtorch by `PYTHONPATH`.

    Raises InputError for a diagnosis without a plant, for a plant that no text can state, with `around` for effects
    within the actuator that are no gain and without `dt`, where the file cannot be written, and without
    `pip install 'avtorch[fmu]'`.

    Example:
        >>> from avtorch.external import write_fmu
        >>> from avtorch.gap import plant
        >>> late = plant(baseline="dead_time=0.2")
        >>> write_fmu(late, "late.fmu", around=True, dt=0.05).name
        'late.fmu'
    """
    source = place(path)
    plant = found if isinstance(found, GapPlant) else found.plant
    if plant is None:
        raise InputError(f"{source}: the diagnosis found no effect, so there is no plant; needs one with a plant")
    text = plant.to_toml()
    GapPlant.from_toml(text)  # as the FMU will read it: only registered effects
    if around:
        if dt is None or not 0 < dt < float("inf"):
            raise InputError(f"dt: found {dt!r}, needs the step of the user's simulator in s")
        Around(plant, dt)
    elif dt is not None:
        raise InputError(f"dt: found {dt!r}, needs none: the whole car takes steps of any length")
    block = {**(_AROUND if around else _CAR), "dt": dt}
    with tempfile.TemporaryDirectory() as folder:
        parts = {"plant.toml": text, "block.json": json.dumps(block), "requirements.txt": "avtorch\n"}
        for name, content in parts.items():
            Path(folder, name).write_text(content, encoding="utf-8")
        script = Path(folder, "avtorch_fmu_script.py")
        shutil.copyfile(Path(__file__).with_name("fmu_slave.py"), script)
        builder = library("pythonfmu.builder", source, _MADE).FmuBuilder
        with _imports_undone(script.stem):
            beside = [Path(folder, name) for name in parts]
            built = builder.build_FMU(script, dest=Path(folder, "built.fmu"), project_files=beside)
        with atomic(path, binary=True) as file:
            file.write(Path(built).read_bytes())
    return Path(path)


@contextmanager
def _imports_undone(module: str) -> Iterator[None]:
    """pythonfmu imports the script here to ask for its variables, and leaves its folder on the path."""
    before = list(sys.path)
    try:
        yield
    finally:
        sys.path[:] = before
        sys.modules.pop(module, None)
