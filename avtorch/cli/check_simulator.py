"""`avtorch check-simulator`: is a simulator what its user set?"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Group, Parameter
from rich.markup import escape

from avtorch.cli.arguments import Json, Quiet
from avtorch.cli.talk import Talk
from avtorch.errors import InputError

BELIEVED = Group("What you believe it is", sort_key=10)


def check_simulator(
    simulator: str,
    /,
    *,
    T: Annotated[float | None, Parameter(name="--T", group=BELIEVED, help="Lag [s].")] = None,
    K: Annotated[float | None, Parameter(name="--K", group=BELIEVED, help="Gain.")] = None,
    delay: Annotated[float | None, Parameter(group=BELIEVED, help="Dead time [s].")] = None,
    step: Annotated[float, Parameter(help="Step of the manoeuvres [s].")] = 0.02,
    mapping: Annotated[Path | None, Parameter(help="TOML file with an FMU's variables.")] = None,
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Is a simulator what you set? Drives it through steps and a sweep, and says what it is made of.

    Parameters
    ----------
    simulator
        MODULE:NAME or FILE.py:NAME of an object with reset(speed, accel) and step(accel_cmd, dt), or an FMU.
    """
    for option, value in (("--T", T), ("--K", K), ("--delay", delay)):
        if value is not None and not 0 <= value < 100:
            raise InputError(f"{option}: found {value:g}, needs a number from 0 to 100")
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
