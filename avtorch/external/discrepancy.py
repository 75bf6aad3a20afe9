"""What a simulator does beyond its surrogate, and a car's log without it.

Let S be the simulator, M its surrogate, and y what the car did under the same commands. The simulator predicts y as

    S(u) = M(u) + d,   d = S(u) - M(u),

so the gap between car and simulator is that between `y - d` and the chain M. A diagnosis with M as its baseline, of a
log from which `d` is subtracted, is a diagnosis of the simulator; `d` is known row by row and needs no model. Effects
and parameters are then asked of M: exact where they act on the output (sensors, forces), where they commute with the
rest of the simulator (a delay), or where M holds what they do not commute with; else to first order in `d`, which is
small where the surrogate is good.
"""

from __future__ import annotations

from dataclasses import replace

from avtorch.arrays import FloatArray
from avtorch.errors import InputError
from avtorch.gap.simulator.plant import GapPlant
from avtorch.gap.simulator.simulator_input import SimulatorInput
from avtorch.io import Log


def responses(drives: Log, plant: GapPlant) -> dict[str, FloatArray]:
    """What `plant` does in `drives` by the channels that these have, (time,): acceleration [m/s²] and speed [m/s], anew
    from each segment's first row. Rows under the driver keep what is there."""
    found = {name: values.copy() for name in ("accel", "speed") if (values := getattr(drives, name)) is not None}
    for segment in range(int(drives.segment[-1]) + 1):
        rows = drives.segment == segment
        if rows.sum() < 2 or not drives.engaged[rows].any():  # under the driver there is no simulator
            continue
        response = plant.response(SimulatorInput.from_log(drives, segment))
        answers = {"accel": response.accel_measured, "speed": response.speed}
        for name, values in found.items():
            values[rows] = answers[name].numpy()
    return found


def discrepancy(simulated: Log, surrogate: GapPlant) -> dict[str, FloatArray]:
    """`d` by channel, (time,): acceleration [m/s²] and, from each segment's start, speed [m/s]."""
    return {name: getattr(simulated, name) - values for name, values in responses(simulated, surrogate).items()}


def without_discrepancy(log: Log, simulated: Log, surrogate: GapPlant) -> Log:
    """The car's `log` less what the simulator does beyond its surrogate, row by row.

    Raises `InputError` where the simulator's output lacks a channel of the log.
    """
    known = discrepancy(simulated, surrogate)
    channels = {name: getattr(log, name) for name in ("accel", "speed") if getattr(log, name) is not None}
    shared = {name: values - known[name] for name, values in channels.items() if name in known}
    if not shared:
        raise InputError(f"{simulated.name}: found {' and '.join(known)}, needs {' or '.join(channels)} as {log.name}")
    return replace(log, **{name: shared.get(name) for name in channels})
