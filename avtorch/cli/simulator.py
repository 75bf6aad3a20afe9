"""The simulator that a command starts from, as it is given on the command line."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

from avtorch.errors import InputError, quoted

if TYPE_CHECKING:
    from avtorch.gap import GapPlant


def read_simulator(option: str, text: str) -> GapPlant | None:
    """None for the bare GLVD, for which the answer also reports the gap that remains once a delay is modelled.

    Raises `InputError` that names the `option`, for a file that is not there and for values out of range.
    """
    from avtorch.gap import plant

    if text.strip().lower() == "glvd":
        return None
    given = f"{option} {quoted(text, 80)}"
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
