"""The process in which FMPy runs an FMU: native code that may end it, hang or answer nonsense.

Arguments are the FMU, its name in messages, an empty folder to unpack it in, and the file of the clock. Requests and
answers are lines of JSON. Before each step the clock gets the simulated time, so that the process that waits knows how
far a crash or a hang has come.

It imports little: starting it is most of the time that a short drive takes.
"""

from __future__ import annotations

import ctypes
import importlib
import json
import math
import os
import sys
import zipfile
from collections.abc import Callable
from typing import Any

import numpy as np

from avtorch.arrays import FloatArray
from avtorch.child_process import answer, answers_to, limit_memory
from avtorch.errors import InputError, listed, printable

NEED = "an FMU of FMI 2 or 3 with co-simulation"
NOT_RUNNING = -1.0
"""What the clock shows outside of steps."""
MOST_BYTES = 4 * 2**30
"""Largest FMU, unpacked. Those that bring the run-time library of a tool have hundreds of MB."""
MOST_MEMORY = 32 * 2**30
"""Bytes of address space, where the system can limit it; the virtual machines of some tools reserve a lot."""

_REALS = ("Real", "Float64", "Float32")
Port = tuple[int, str]
"""Reference and type of a variable."""


class _Stopped(Exception):
    """A drive that goes no further, and why."""


class RunningFmu:
    """An FMU of which one instance at a time runs. Raises `InputError` for what cannot be run here."""

    def __init__(self, path: str, source: str, folder: str) -> None:
        try:
            fmpy, fmi2, fmi3 = (importlib.import_module(f"fmpy{part}") for part in ("", ".fmi2", ".fmi3"))
        except Exception as fault:
            raise InputError(
                f"{source}: running an FMU needs fmpy, which cannot be loaded here ({reason(fault)}): "
                "pip install --force-reinstall 'avtorch[fmu]'"
            ) from None
        self._said = ""
        self._running = False
        try:
            _unpack(fmpy, path, source, folder)
            self.remarks: tuple[str, ...] = ()
            try:
                self._described = fmpy.read_model_description(folder)
            except fmpy.model_description.ValidationError as fault:
                self._described = fmpy.read_model_description(folder, validate=False)
                problem = printable(str(fault.problems[0]), 160)
                self.remarks = (f"modelDescription.xml departs from the standard ({problem})",)
            self._fmu, self._options = self._loaded(fmpy, fmi2, fmi3, source, folder)
        except InputError:
            raise
        except Exception as fault:
            raise InputError(
                f"{source}: is damaged or of an unknown kind ({reason(fault)}); {NEED} is needed"
            ) from None

    def _loaded(self, fmpy: Any, fmi2: Any, fmi3: Any, source: str, folder: str) -> tuple[Any, dict[str, Any]]:
        """The FMU's library, and how it is instantiated so that its last complaint is kept."""
        version, kind = str(self._described.fmiVersion), self._described.coSimulation
        if kind is None or not version.startswith(("2.", "3.")):
            found = "model exchange alone" if kind is None else "co-simulation"
            raise InputError(f"{source}: is of FMI {printable(version, 20)} with {found}; {NEED} is needed")
        here = fmpy.platform if version.startswith("2") else fmpy.platform_tuple
        binaries = os.path.join(folder, "binaries")
        if not os.path.isfile(os.path.join(binaries, here, kind.modelIdentifier + fmpy.sharedLibraryExtension)):
            others = sorted(os.listdir(binaries)) if os.path.isdir(binaries) else []
            has = f"binaries for {listed(others)}" if others else "no binaries"
            raise InputError(f"{source}: has {has}; this machine needs {here}")
        given = {"guid": self._described.guid, "unzipDirectory": folder, "modelIdentifier": kind.modelIdentifier}
        if version.startswith("3"):
            return fmi3.FMU3Slave(instanceName="avtorch", **given), {
                "logMessage": lambda env, status, kind, text: self._hear(status, text)
            }
        callbacks = fmi2.fmi2CallbackFunctions()
        callbacks.logger = fmi2.fmi2CallbackLoggerTYPE(
            lambda env, name, status, category, text: self._hear(status, text)
        )
        callbacks.allocateMemory = fmi2.fmi2CallbackAllocateMemoryTYPE(fmpy.calloc)
        callbacks.freeMemory = fmi2.fmi2CallbackFreeMemoryTYPE(fmpy.free)
        fmpy.logging.addLoggerProxy(ctypes.byref(callbacks))
        return fmi2.FMU2Slave(instanceName="avtorch", **given), {"callbacks": callbacks}

    def _hear(self, status: int, text: bytes | None) -> None:
        if status > 1 and text:
            self._said = " ".join(text.decode("utf-8", "replace").split())

    def listing(self) -> dict[str, Any]:
        """Its variables, units and steps, for JSON."""
        described, kind = self._described, self._described.coSimulation
        units = {unit.name: unit.baseUnit for unit in described.unitDefinitions if unit.baseUnit is not None}
        experiment = described.defaultExperiment
        step = _number(kind.fixedInternalStepSize or (None if experiment is None else experiment.stepSize))
        return {
            "form": f"FMI {described.fmiVersion}",
            "made_by": described.generationTool or "",
            "variable_step": bool(kind.canHandleVariableCommunicationStepSize),
            "step": step if step is not None and 0 < step < math.inf else None,
            "remarks": self.remarks,
            "variables": [_variable(v, units) for v in described.modelVariables if not v.shape],
        }

    def begin(self, values: list[tuple[int, str, float]], command: Port, at: float, outputs: list[Port]) -> list[float]:
        """Begin a drive with these start values and the command at `at`; what the outputs then show."""
        fmu, two = self._fmu, self._described.fmiVersion.startswith("2")
        self._said = ""
        if self._running:
            self._running = False
            (fmu.fmi2FreeInstance if two else fmu.fmi3FreeInstance)(fmu.component)
        fmu.instantiate(loggingOn=True, **self._options)
        self._running = True
        if two:
            fmu.setupExperiment(startTime=0.0)
        for reference, type_, value in values:
            getattr(fmu, f"set{type_}")([reference], [value if type_ in _REALS else int(value)])
        fmu.enterInitializationMode()
        set_command = getattr(fmu, f"set{command[1]}")
        self._send: Callable[[float], None] = lambda u: set_command([command[0]], [u])
        self._send(at)
        fmu.exitInitializationMode()
        self._gets = [(getattr(fmu, f"get{type_}"), [reference]) for reference, type_ in outputs]
        self._time = self._base = 0.0
        self._taken, self._length = 0, math.nan
        return self._shown()

    def _shown(self) -> list[float]:
        return [float(get(reference)[0]) for get, reference in self._gets]

    def drive(self, steps: list[tuple[float, float, int]], clock: FloatArray) -> list[list[float]]:
        """Hold each command over so many steps of a length [s]; the outputs (row, output) at the end of each."""
        rows = []
        for u, length, count in steps:
            clock[0] = self._time
            self._send(u)
            for _ in range(count):
                clock[0] = self._time
                self._step(length)
            rows.append(self._shown())
            if not all(map(math.isfinite, rows[-1])):
                raise _Stopped(
                    f"it answers {', '.join(f'{x:g}' for x in rows[-1])} after steps of {length:g} s; finite numbers "
                    f"are needed, which smaller steps may give (--step {length / 5:g}, in Python step_s)"
                )
        return rows

    def _step(self, length: float) -> None:
        if length != self._length:  # times are multiples of the step, as long as it is the same one
            self._base, self._taken, self._length = self._time, 0, length
        ended = self._fmu.doStep(self._time, length)
        if ended is not None:  # FMI 3
            _, terminated, early, reached = ended
            if terminated:
                raise _Stopped("it ends the simulation")
            if early:
                raise _Stopped(f"it returns at {reached:g} s, before the end of its step of {length:g} s")
        self._taken += 1
        self._time = self._base + self._taken * length

    def why(self, fault: Exception) -> str:
        """An error of the FMU in one line, with what the FMU said of it."""
        if isinstance(fault, _Stopped):
            return str(fault)
        return reason(fault) + (f": {printable(self._said, 200)}" if self._said else "")


def _unpack(fmpy: Any, path: str, source: str, folder: str) -> None:
    with zipfile.ZipFile(path) as archive:
        size = sum(entry.file_size for entry in archive.infolist())
        names = archive.namelist()
    if size > MOST_BYTES:
        raise InputError(f"{source}: unpacks to {size:,} bytes; needs {MOST_BYTES:,} at most")
    if "modelDescription.xml" not in names:
        raise InputError(f"{source}: is a ZIP file without modelDescription.xml; {NEED} is needed")
    fmpy.extract(path, folder)


def _variable(v: Any, units: dict[str, Any]) -> dict[str, Any]:
    unit = v.unit or (v.declaredType.unit if v.declaredType is not None else None)
    base = units.get(unit or "")
    powers = {name: getattr(base, name) for name in ("kg", "m", "s", "A", "K", "mol", "cd", "rad")} if base else None
    return {
        "name": v.name,
        "reference": v.valueReference,
        "type": v.type,
        "causality": v.causality,
        "settable": v.variability != "constant" and (v.initial == "exact" or v.causality == "input"),
        "unit": unit,
        "powers": {name: power for name, power in powers.items() if power} if powers is not None else None,
        "factor": base.factor if base else 1.0,
        "offset": base.offset if base else 0.0,
        "start": _number(v.start),
        "least": _number(v.min),
        "most": _number(v.max),
    }


def _number(text: str | None) -> float | None:
    try:
        return None if text is None else float(text)
    except ValueError:  # of a text, or an enumeration's name
        return None


def reason(fault: Exception) -> str:
    """A library's message in one short line, without the paths of the temporary folder."""
    text = " ".join(word.rsplit("/", 1)[-1] for word in str(fault).split())
    kind = type(fault).__name__
    return printable(text.removesuffix(".") if kind == "FMICallException" else f"{kind}: {text}", 160)


def main() -> None:
    """Serve one FMU until the standard input ends, or until an error, after which nothing is certain of an FMU."""
    limit_memory(MOST_MEMORY)
    out = answers_to()
    path, source, folder, clock_file = sys.argv[1:]
    clock = np.memmap(clock_file, np.float64, "r+", shape=(1,))
    try:
        fmu = RunningFmu(path, source, folder)
    except InputError as fault:
        answer(out, {"refused": str(fault)})
        return
    answer(out, fmu.listing())
    for line in sys.stdin.buffer:
        request = json.loads(line)
        try:
            shown = fmu.drive(request["steps"], clock) if "steps" in request else fmu.begin(**request)
        except Exception as fault:
            answer(out, {"error": fmu.why(fault)})
            return
        clock[0] = NOT_RUNNING
        answer(out, {"shown": shown})


if __name__ == "__main__":
    main()
    os._exit(0)  # an FMU that is still loaded may crash while the interpreter ends
