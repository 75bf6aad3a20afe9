"""Simulators as given on the command line (effects or TOML, an object or FMU, columns of a log); `check-simulator`."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Group
from rich.markup import escape

from avtorch.cli import arguments as arg
from avtorch.cli.talk import Talk
from avtorch.errors import InputError, quoted

if TYPE_CHECKING:
    from avtorch.external import ExternalSimulator
    from avtorch.gap import GapPlant
    from avtorch.io import Log

_CHANNELS = ("accel", "speed")
_OPTIONS = {
    "adjustable": "--adjust",
    "most_rollouts": "--rollouts",
    "processes": "--processes",
    "simulator": "--simulator",
}
"""Options by how errors of what they hold begin."""


def read_simulator(option: str, text: str) -> GapPlant | None:
    """None for the bare GLVD, for which the answer also reports the gap that remains once a delay is modelled.

    Raises `InputError` that names the `option`, for a file that is not there and for values out of range.
    """
    from avtorch.gap import plant

    if text.strip().lower() == "glvd":
        return None
    given = f"{option} {quoted(text, 80)}"
    if option != "--simulator":
        _refuse_code(option, text)
    if text.endswith(".toml") and not os.path.lexists(text):
        raise InputError(f"{given}: no such file; needs a TOML file, or effects such as dead_time=0.2")
    try:
        simulator = plant(baseline=text)
    except InputError as fault:
        raise InputError(f"{given}: {fault}") from None
    known = simulator.parameters()
    for name, value in simulator.values().items():
        # the ends of an interval are a drive's, which is not known yet
        if known[name].constraint != "interval" and known[name].unconstrain(value).isnan().any():
            raise InputError(f"{given}: {name} is {value.tolist():g}, needs a {known[name].constraint} number")
    return simulator


def simulator_of(
    simulated: Sequence[str],
    simulator: str | None,
    step: float | None,
    drives: Sequence[tuple[Path, Log]],
    *,
    adjust: Sequence[str] = (),
    rollouts: int | None = None,
    processes: int = 1,
) -> ExternalSimulator | None:
    """None where neither is given. Raises `InputError` where both are, or what is given cannot be read."""
    if simulator is None:
        for option, given in (("--step", step is not None), ("--adjust", adjust), ("--rollouts", rollouts is not None)):
            if given:
                raise InputError(f"{option}: has a meaning with --simulator only")
    if not simulated and simulator is None:
        return None
    if simulated and simulator is not None:
        raise InputError("--simulated, --simulator: found both, needs the output or the simulator itself")
    from avtorch.external import ExternalSimulator, load_simulator
    from avtorch.io.mapping import mapping_beside

    if simulator is not None:
        if rollouts is not None and not adjust:
            raise InputError("--rollouts: has a meaning with --adjust only")
        limits = _limits(adjust)
        try:
            own = load_simulator(simulator, mapping=mapping_beside(drives[0][0]))
            most = ExternalSimulator.most_rollouts if rollouts is None else rollouts
            return ExternalSimulator(own, simulator, step, adjustable=limits, most_rollouts=most, processes=processes)
        except InputError as fault:
            text = str(fault)
            for start, option in _OPTIONS.items():
                if text.startswith(start):
                    raise InputError(f"{option}{text.removeprefix(start)}") from None
            raise InputError(f"--simulator: {text}") from None
    if len(simulated) == 1 and not Path(simulated[0]).exists() and simulated[0].endswith((".", "_")):
        return ExternalSimulator([_columns(simulated[0], path, drive) for path, drive in drives], name=simulated[0])
    for text in simulated:
        _refuse_code("--simulated", text)
    if len(simulated) != len(drives):
        raise InputError(f"--simulated: found {len(simulated)} files for {len(drives)} logs, needs one for each log")
    from avtorch.io import Log

    outputs = [Log.read(path) for path in simulated]
    return ExternalSimulator(outputs, name=", ".join(Path(path).name for path in simulated))


def refuse_loop(simulated: Sequence[str] | None, drives: Sequence[Log]) -> None:
    """Raises `InputError` where the output of a simulator stands beside drives by a commanded speed: it follows that by
    a loop of its own, and the acceleration that a map makes of the car's loop is not its command."""
    for drive in drives if simulated else ():
        if drive.accel_cmd is None and not drive.pedals and drive.speed_cmd is not None:
            raise InputError(
                f"--simulated: {drive.name} commands a speed, which car and simulator follow by loops of their own; "
                "needs accel_cmd or a pedal, or leave --simulated out to diagnose the car alone"
            )


def simulators_of(
    simulator: Sequence[str], simulated: Sequence[str], step: float | None, path: Path, drive: Log
) -> list[ExternalSimulator | str]:
    """Simulators of any kind beside one log, those of --simulator first: plants as text, objects, FMUs, output.

    Raises `InputError` for what cannot be read.
    """
    found: list[ExternalSimulator | str | None] = []
    for text in simulator:
        if text.lower().endswith(".toml") or not (":" in text or text.lower().endswith(".fmu")):
            if read_simulator("--simulator", text) is None:
                raise InputError("--simulator: found glvd, which would be fitted to the log; needs its T_L, as T_L=0.4")
            found.append(text)
        else:
            found.append(simulator_of((), text, step, [(path, drive)]))
    if step is not None and all(isinstance(x, str) for x in found):
        raise InputError("--step: has a meaning with an object or an FMU as --simulator only")
    found += [simulator_of((text,), None, None, [(path, drive)]) for text in simulated]
    return [x for x in found if x is not None]


def _refuse_code(option: str, text: str) -> None:
    """Raises `InputError` where a simulator itself is given to an option that takes its output or its equations."""
    if text.lower().endswith(".fmu") or text.partition(":")[0].endswith(".py"):
        raise InputError(f"{option} {quoted(text, 80)}: is a simulator itself; needs --simulator in place of {option}")


def _limits(adjust: Sequence[str]) -> dict[str, tuple[float, float]]:
    """`NAME=LOW:HIGH` by name."""
    out = {}
    for text in adjust:
        name, equals, ends = text.partition("=")
        low, colon, high = ends.partition(":")
        try:
            out[name.strip()] = float(low), float(high)
        except ValueError:
            equals = ""
        if not equals or not colon or not name.strip():
            raise InputError(f"--adjust: found {quoted(text)}, needs NAME=LOW:HIGH, such as lag=0.1:1.0")
    return out


def _columns(prefix: str, path: Path, drive: Log) -> Log:
    """The simulator's output in columns of the log itself, such as `sim.speed`."""
    from avtorch.io import Log

    there = {name: f"{prefix}{name}" for name in _CHANNELS if f"{prefix}{name}" in drive.ignored}
    if not there:
        known = ", ".join(drive.ignored[:8]) or "no further columns"
        raise InputError(
            f"--simulated {quoted(prefix)}: no such file, and {path} has no column {prefix}accel or {prefix}speed "
            f"(it has {known})"
        )
    read = Log.read(path, map=there)
    return replace(read, name=f"{prefix}*", **{name: None for name in _CHANNELS if name not in there})


BELIEVED = Group("What you believe it is", sort_key=10)


def check_simulator(
    simulator: str,
    /,
    *,
    T: Annotated[float | None, arg.zero_or_more("Lag [s].", "s", group=BELIEVED, name="--T")] = None,
    K: Annotated[float | None, arg.zero_or_more("Gain.", group=BELIEVED, name="--K")] = None,
    delay: Annotated[float | None, arg.zero_or_more("Dead time [s].", "s", group=BELIEVED)] = None,
    step: Annotated[float, arg.option("Step of the manoeuvres [s].")] = 0.02,
    mapping: Annotated[Path | None, arg.option("TOML file with an FMU's variables.")] = None,
    json: arg.Json = False,
    quiet: arg.Quiet = False,
) -> None:
    """Is a simulator what you set? Drives it through steps and a sweep, and says what it is made of.

    Parameters
    ----------
    simulator
        MODULE:NAME or FILE.py:NAME of an object with reset(speed, accel) and step(accel_cmd, dt), or an FMU.
    """
    from avtorch.external import check_simulator as work
    from avtorch.external import load_simulator
    from avtorch.gap.simulator.effect import delay_key

    believed = {"T_L": T, "K_L": K, delay_key(): delay}
    talk = Talk(json=json, quiet=quiet)
    found = work(load_simulator(simulator, mapping=mapping), name=simulator, step_s=step)
    told = {name: value for name, value in believed.items() if value is not None}
    if talk.json:
        talk.answer(found.to_dict() | {"believed": told})
        return
    talk.out.print(escape(str(found)))
    for name, value in told.items():
        obtained = found.values.get(name, 0.0)
        same = abs(obtained - value) <= max(0.05 * abs(value), 0.01)
        style = "green" if same else "bold yellow"
        verb = "as set" if same else "not as set"
        talk.out.print(f"[{style}]{escape(name)}: {value:g} set, {obtained:.3g} obtained, {verb}[/]")
