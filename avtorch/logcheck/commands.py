"""Which columns command the car where none is an acceleration: its pedals, a torque, a current or a speed.

One column drives the car. Beside it, another torque or current is as likely what the motor answered, and a pedal left
out is force that comes from nowhere: so each that is left over is asked about.
"""

from __future__ import annotations

from collections.abc import Collection

import numpy as np

from avtorch.io.mapping import PEDALS
from avtorch.io.unit_names import stated_unit
from avtorch.io.units import to_si
from avtorch.logcheck.assignment import is_state, moves
from avtorch.logcheck.candidates import Column, ranked
from avtorch.logcheck.header import bare_unit
from avtorch.logcheck.vocabulary import is_answer, is_asked

DRIVES = ("throttle", "torque", "current", "speed_cmd")
"""Commands of which one drives the car, those nearest to the actuator first."""
COMMANDS = (*PEDALS, "speed_cmd")
_MOST_SHARE, _MOST_PERCENT = 1.2, 120.0  # of a pedal's way; it may be calibrated a little wrongly


def commands_of(columns: list[Column], given: Collection[str], commanded: bool) -> tuple[dict[str, Column], list[str]]:
    """Commands by signal, and doubts; `commanded`: an acceleration is, beside which only what bears the very name of a
    command is read; `given`: signals that the user named."""
    may: dict[str, list[Column]] = {
        signal: [c for c in ranked(columns, signal) if moves(c) and (not is_state(c) or c.name == signal)]
        for signal in COMMANDS
        if signal not in given
    }
    found = {signal: own[0] for signal, some in may.items() if (own := [c for c in some if c.likeness[signal] > 1])}
    if commanded:
        return found, []
    if not {*found, *given} & set(DRIVES):
        drives = [signal for signal in DRIVES if may[signal]]
        # what says that it is asked for comes before what may be an answer
        drives.sort(key=lambda signal: (not is_asked(may[signal][0].header), is_answer(may[signal][0].header)))
        found |= {signal: may[signal][0] for signal in drives[:1]}
    if may.get("brake"):
        found.setdefault("brake", next((c for c in may["brake"] if c not in found.values()), may["brake"][0]))
    used = [column.name for column in found.values()]
    left: dict[str, str] = {}
    for signal, some in may.items():
        for column in some:
            if column.name not in used and not is_answer(column.header):
                left.setdefault(column.name, signal)
    if len(used) != len(set(used)):  # one column for two commands
        found.pop("brake")
    doubts = [
        f"{name} may command the car as well, or be its answer; if the car obeys it, name it with --map {signal}=COLUMN"
        for name, signal in left.items()
        if found or given
    ]
    return found, doubts


def unit_of_command(signal: str, column: Column) -> tuple[str | None, str | None]:
    """The unit of a command, None for SI, and a doubt: as stated, else by its size; negative where less is more."""
    stated = column.header.unit or bare_unit(column.header, signal)
    unit, doubt = (stated_unit(signal, stated) if stated else None), None
    values = column.values[np.isfinite(column.values)]
    top = float(np.abs(values).max())
    if unit is None and signal in ("throttle", "brake") and top > _MOST_SHARE:
        if signal == "brake" and "torque" in column.header.words:
            unit = "Nm"
        elif top <= _MOST_PERCENT:
            unit = "%"
        elif signal == "brake":
            doubt = (
                f"{column.name} reaches {top:.4g}: say with --unit brake=kPa, --unit brake=Nm or another unit whether "
                "it is a pressure or a torque"
            )
    if signal == "brake" and float(np.quantile(values, 0.99)) <= 0 > float(values.min()):
        return f"{-float(to_si(signal, unit or '1')(np.ones(1))[0]):.10g}", doubt
    return (None if unit in (None, "m/s", "A", "Pa") or (unit == "Nm" and signal == "torque") else unit), doubt
