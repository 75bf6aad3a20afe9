"""The process in which an FMU runs: native code that may end it, hang or answer nonsense.

Arguments are the FMU, its name in messages, an empty folder to unpack it in, and the file of the clock. Each request
is a line of JSON and the numbers it announces; each answer is a line of JSON, then numbers. Before each step the clock
gets the simulated time, so that the process that waits knows how far a crash or a hang has come.

It imports little: starting it is most of the time that a short drive takes.
"""

from __future__ import annotations

import ctypes
import importlib
import json
import math
import mmap
import os
import sys
import zipfile
from typing import Any, BinaryIO

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

_REALS = {"Real": ctypes.c_double, "Float64": ctypes.c_double, "Float32": ctypes.c_float}
Port = tuple[int, str]
"""Reference and type of a variable."""


class _Stopped(Exception):
    """A drive that goes no further, and why."""


class RunningFmu:
    """An FMU of which one instance at a time runs."""

    def __init__(self, path: str, where: str, folder: str) -> None:
        self._where = where
        try:
            fmpy, self._fmi2, self._fmi3 = (importlib.import_module(f"fmpy{part}") for part in ("", ".fmi2", ".fmi3"))
        except Exception as fault:
            raise InputError(
                f"{where}: running an FMU needs fmpy, which cannot be loaded here ({reason(fault)}): "
                "pip install --force-reinstall 'avtorch[fmu]'"
            ) from None
        try:
            self._unpack(fmpy, path, folder)
            self.remarks: tuple[str, ...] = ()
            try:
                self._described = fmpy.read_model_description(folder)
            except fmpy.model_description.ValidationError as fault:
                self._described = fmpy.read_model_description(folder, validate=False)
                problem = printable(str(fault.problems[0]), 160)
                self.remarks = (f"modelDescription.xml departs from the standard ({problem})",)
            self._fmu = self._loaded(fmpy, folder)
        except InputError:
            raise
        except Exception as fault:
            raise InputError(f"{where}: is damaged or of an unknown kind ({reason(fault)}); {NEED} is needed") from None
        self._said = ""
        self._running = False
        self._time = self._base = 0.0
        self._taken, self._length = 0, math.nan

    def _unpack(self, fmpy: Any, path: str, folder: str) -> None:
        with zipfile.ZipFile(path) as archive:
            size = sum(entry.file_size for entry in archive.infolist())
            names = archive.namelist()
        if size > MOST_BYTES:
            raise InputError(f"{self._where}: unpacks to {size:,} bytes; needs {MOST_BYTES:,} at most")
        if "modelDescription.xml" not in names:
            raise InputError(f"{self._where}: is a ZIP file without modelDescription.xml; {NEED} is needed")
        fmpy.extract(path, folder)

    def _loaded(self, fmpy: Any, folder: str) -> Any:
        described = self._described
        version, kind = str(described.fmiVersion), described.coSimulation
        if kind is None or not version.startswith(("2.", "3.")):
            found = "model exchange alone" if kind is None else "co-simulation"
            raise InputError(f"{self._where}: is of FMI {printable(version, 20)} with {found}; {NEED} is needed")
        here = fmpy.platform if version.startswith("2") else fmpy.platform_tuple
        binaries = os.path.join(folder, "binaries")
        if not os.path.isfile(os.path.join(binaries, here, kind.modelIdentifier + fmpy.sharedLibraryExtension)):
            others = sorted(os.listdir(binaries)) if os.path.isdir(binaries) else []
            has = f"binaries for {listed(others)}" if others else "no binaries"
            raise InputError(f"{self._where}: has {has}; this machine needs {here}")
        given = {"guid": described.guid, "unzipDirectory": folder, "modelIdentifier": kind.modelIdentifier}
        if version.startswith("2"):
            self._callbacks = self._logged(fmpy)
            return self._fmi2.FMU2Slave(instanceName="avtorch", **given)
        return self._fmi3.FMU3Slave(instanceName="avtorch", **given)

    def _logged(self, fmpy: Any) -> Any:
        """Callbacks that keep the last complaint of an FMU of FMI 2."""
        fmi2 = self._fmi2
        callbacks = fmi2.fmi2CallbackFunctions()
        callbacks.logger = fmi2.fmi2CallbackLoggerTYPE(lambda env, name, status, kind, text: self._hear(status, text))
        callbacks.allocateMemory = fmi2.fmi2CallbackAllocateMemoryTYPE(fmpy.calloc)
        callbacks.freeMemory = fmi2.fmi2CallbackFreeMemoryTYPE(fmpy.free)
        fmpy.logging.addLoggerProxy(ctypes.byref(callbacks))
        return callbacks

    def _hear(self, status: int, text: bytes | None) -> None:
        if status > 1 and text:
            self._said = " ".join(text.decode("utf-8", "replace").split())

    # what it has ---------------------------------------------------------------------------------------------------
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

    # drives --------------------------------------------------------------------------------------------------------
    def reset(self, values: list[tuple[int, str, float]], command: Port, at: float, outputs: list[Port]) -> list[float]:
        """Begin a drive with these start values and the command at `at`; what the outputs then show."""
        fmu, two = self._fmu, self._described.fmiVersion.startswith("2")
        self._said = ""
        if self._running:
            self._running = False
            free = fmu.fmi2FreeInstance if two else fmu.fmi3FreeInstance
            free(fmu.component)
        if two:
            fmu.instantiate(callbacks=self._callbacks, loggingOn=True)
            fmu.setupExperiment(startTime=0.0)
        else:
            fmu.instantiate(loggingOn=True, logMessage=lambda env, status, kind, text: self._hear(status, text))
        self._running = True
        for reference, type_, value in values:
            getattr(fmu, f"set{type_}")([reference], [value if type_ in _REALS else int(value)])
        fmu.enterInitializationMode()
        self._set, self._command = self._port(command, "Set")
        self._gets = [self._port(port, "Get") for port in outputs]
        self._command[0] = at
        self._set()
        fmu.exitInitializationMode()
        self._time = self._base = 0.0
        self._taken, self._length = 0, math.nan
        return self._shown()

    def _port(self, port: Port, way: str) -> tuple[Any, Any]:
        """A call that sets or gets one number, and the cell that it lies in."""
        fmu, (reference, type_) = self._fmu, port
        version = self._described.fmiVersion[0]
        call = getattr(fmu, f"fmi{version}{way}{type_}")
        references, cell = (ctypes.c_uint * 1)(reference), (_REALS[type_] * 1)()
        given = (fmu.component, references, 1, cell) + (() if version == "2" else (1,))
        return lambda: call(*given), cell

    def _shown(self) -> list[float]:
        for get, _ in self._gets:
            get()
        return [float(cell[0]) for _, cell in self._gets]

    def drive(self, command: FloatArray, length: FloatArray, count: FloatArray, clock: memoryview[float]) -> FloatArray:
        """Hold each command over `count` steps of `length` [s]; the outputs at the end of each (output, row)."""
        shown = np.empty((len(self._gets), len(command)))
        for k, (u, h, n) in enumerate(zip(command.tolist(), length.tolist(), count.astype(int).tolist(), strict=True)):
            self._command[0], clock[0] = u, self._time
            self._set()
            for _ in range(n):
                clock[0] = self._time
                self._step(h)
            shown[:, k] = self._shown()
            if not np.isfinite(shown[:, k]).all():
                raise _Stopped(
                    f"it answers {', '.join(f'{x:g}' for x in shown[:, k])} after steps of {h:g} s; finite numbers are "
                    f"needed, which smaller steps may give (--step {h / 5:g}, in Python step_s)"
                )
        return shown

    def _step(self, h: float) -> None:
        if h != self._length:  # times are multiples of the step, as long as it is the same one
            self._base, self._taken, self._length = self._time, 0, h
        ended = self._fmu.doStep(self._time, h)
        if ended is not None:  # FMI 3
            _, terminated, early, reached = ended
            if terminated:
                raise _Stopped("it ends the simulation")
            if early:
                raise _Stopped(f"it returns at {reached:g} s, before the end of its step of {h:g} s")
        self._taken += 1
        self._time = self._base + self._taken * self._length

    def why(self, fault: Exception) -> str:
        """An error of the FMU in one line, with what the FMU said of it."""
        if isinstance(fault, _Stopped):
            return str(fault)
        return reason(fault) + (f": {printable(self._said, 200)}" if self._said else "")


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


def serve(fmu: RunningFmu, requests: BinaryIO, out: BinaryIO, clock: memoryview[float]) -> None:
    """Answer each of the requests; an error ends it, for nothing is certain of an FMU after one."""
    for line in requests:
        request = json.loads(line)
        try:
            if "rows" in request:
                rows = request["rows"]
                command, length, count = np.frombuffer(requests.read(24 * rows)).reshape(3, rows)
                shown = fmu.drive(command, length, count, clock)
            else:
                shown = np.array(fmu.reset(**request))
        except Exception as fault:
            answer(out, {"error": fmu.why(fault)})
            return
        clock[0] = NOT_RUNNING
        answer(out, {"numbers": shown.size}, [shown])


def main() -> None:
    """Serve one FMU until the standard input ends."""
    limit_memory(MOST_MEMORY)
    out = answers_to()
    path, where, folder, clock_file = sys.argv[1:]
    with open(clock_file, "r+b") as file:
        clock = memoryview(mmap.mmap(file.fileno(), 8)).cast("d")
    try:
        fmu = RunningFmu(path, where, folder)
    except InputError as fault:
        answer(out, {"refused": str(fault)})
        return
    answer(out, fmu.listing())
    serve(fmu, sys.stdin.buffer, out, clock)


if __name__ == "__main__":
    main()
    os._exit(0)  # an FMU that is still loaded may crash while the interpreter ends
