"""The process in which FMPy runs an FMU: native code that may end it, hang or answer nonsense.

Arguments are the FMU and an empty folder to unpack it in. Requests and answers are lines of JSON; each step of a drive
has an answer of its own, so that the process that waits knows how far a crash or a hang has come.

It imports little: starting it is most of the time that a short drive takes.
"""

from __future__ import annotations

import json
import math
import os
import sys
from typing import Any

from avtorch.child_process import answer, answers_to, limit_memory
from avtorch.errors import InputError, printable

NEED = "an FMU of FMI 2 or 3 with co-simulation"
MOST_MEMORY = 32 * 2**30
"""Bytes of address space, where the system can limit it; the virtual machines of some tools reserve a lot."""


class RunningFmu:
    """An FMU of which one instance at a time runs, unpacked in a new `folder`. Raises `InputError` for what cannot be
    run here."""

    def __init__(self, path: str, folder: str) -> None:
        self._said, self._folder = "", folder
        self._described: Any
        try:
            import fmpy

            fmpy.extract(path, folder)
            self._described = fmpy.read_model_description(folder, validate=False)
            version, kind = str(self._described.fmiVersion), self._described.coSimulation
            if kind is None or not version.startswith(("2.", "3.")):
                found = "model exchange alone" if kind is None else "co-simulation"
                raise InputError(f"is of FMI {printable(version, 20)} with {found}; {NEED} is needed")
            if fmpy.platform not in fmpy.supported_platforms(folder):
                raise InputError(f"has no library for this machine, needs one for {fmpy.platform}")
            self._fmu, self._fresh = self._instance(), True
        except InputError:
            raise
        except Exception as fault:
            raise InputError(f"is damaged or of an unknown kind ({reason(fault)}); {NEED} is needed") from None

    def _instance(self) -> Any:
        from fmpy.simulation import instantiate_fmu

        return instantiate_fmu(self._folder, self._described, "CoSimulation", debug_logging=True, logger=self._hear)

    def _hear(self, *said: Any) -> None:
        """Keep the last complaint: status, category and text, behind what FMI 2 and 3 each put before them."""
        status, _, text = said[-3:]
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
            "variables": [_variable(v, units) for v in described.modelVariables if not v.shape],
        }

    def begin(self, values: dict[str, float], command: str, at: float, outputs: list[str]) -> list[float]:
        """Begin a drive with these start values and the command at `at`; what the outputs then show. All by name."""
        from fmpy.simulation import apply_start_values

        two = str(self._described.fmiVersion).startswith("2")
        self._said = ""
        if not self._fresh:
            (self._fmu.fmi2FreeInstance if two else self._fmu.fmi3FreeInstance)(self._fmu.component)
            self._fmu = self._instance()
        self._fresh = False
        if two:
            self._fmu.setupExperiment(startTime=0.0)
        apply_start_values(self._fmu, self._described, values)
        self._fmu.enterInitializationMode()
        known = {v.name: v for v in self._described.modelVariables}
        self._command, self._outputs = known[command], [known[name] for name in outputs]
        self._send(at)
        self._fmu.exitInitializationMode()
        self._time = 0.0
        return self._shown()

    def _send(self, command: float) -> None:
        getattr(self._fmu, f"set{self._command.type}")([self._command.valueReference], [command])

    def _shown(self) -> list[float]:
        return [float(getattr(self._fmu, f"get{v.type}")([v.valueReference])[0]) for v in self._outputs]

    def step(self, command: float, length: float, count: int) -> list[float]:
        """Hold the command over so many steps of a `length` [s]; the outputs at the end. Raises `InputError` where
        they are no numbers, or the FMU stops before."""
        self._send(command)
        for _ in range(count):
            ended = self._fmu.doStep(self._time, length)
            if ended is not None and (ended[1] or ended[2]):  # FMI 3
                raise InputError(f"it stops at {ended[3]:g} s, before the end of its step of {length:g} s")
            self._time += length
        shown = self._shown()
        if not all(map(math.isfinite, shown)):
            raise InputError(
                f"it answers {', '.join(f'{x:g}' for x in shown)} after steps of {length:g} s; finite numbers are "
                f"needed, which smaller steps may give (--step {length / 5:g}, in Python step_s)"
            )
        return shown

    def why(self, fault: Exception) -> str:
        """An error of the FMU in one line, with what the FMU said of it."""
        if isinstance(fault, InputError):
            return str(fault)
        return reason(fault) + (f": {printable(self._said, 200)}" if self._said else "")


def _variable(v: Any, units: dict[Any, Any]) -> dict[str, Any]:
    unit = v.unit or (v.declaredType.unit if v.declaredType is not None else None)
    base = units.get(unit or "")
    powers = {name: getattr(base, name) for name in ("kg", "m", "s", "A", "K", "mol", "cd", "rad")} if base else None
    return {
        "name": v.name,
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
    try:
        fmu = RunningFmu(*sys.argv[1:])
    except InputError as fault:
        answer(out, {"refused": str(fault)})
        return
    answer(out, fmu.listing())
    for line in sys.stdin.buffer:
        request = json.loads(line)
        try:
            if "steps" not in request:
                answer(out, {"shown": fmu.begin(**request)})
            for step in request.get("steps", ()):
                answer(out, {"shown": fmu.step(*step)})
        except Exception as fault:
            answer(out, {"error": fmu.why(fault)})
            return


if __name__ == "__main__":
    main()
    os._exit(0)  # an FMU that is still loaded may crash while the interpreter ends
