"""Is a simulator what its user set? It is driven through manoeuvres that show every part of a chain, and identified.

What a parameter is called in a simulator's settings and what it does in the drive are two things: a lag of 0.4 s may
become 0.8 s by a filter before it. The manoeuvres are steps of every size, either way, and a sweep, at several speeds.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from avtorch.arrays import FloatArray
from avtorch.display import Card, Displayed, Frame
from avtorch.errors import InputError
from avtorch.external.driving import driven_along
from avtorch.external.simulator import Simulator
from avtorch.external.surrogate import Surrogate, surrogate_of
from avtorch.gap.quantity import unit_of, words_of
from avtorch.io import Log

SPEEDS_MPS = (10.0, 18.0, 26.0)
STEP_S = 0.02
_STEPS = (0.05, -0.05, 0.15, -0.15, 0.4, -0.4, 1.0, -1.0, 2.5, -2.5, 0.8, -2.0, 1.2)
_HOLD_S, _REST_S = 1.6, 1.0
_ENOUGH = 0.005  # of the response: an integrator of the simulator's own leaves some thousandths
_SWEEP_S, _SWEEP_HZ = 20.0, (0.05, 1.5)


@dataclass(frozen=True, repr=False)
class SimulatorCheck(Displayed):
    """What a simulator called `name` does, as a chain of effects (`surrogate`), and the `output` it was found from."""

    name: str
    surrogate: Surrogate
    output: Log

    def overview(self) -> Card:
        """The chain of effects that answers as it does."""
        rows = [{"parameter": name, "unit": unit_of(name), "value": value} for name, value in self.values.items()]
        line = f"That is all but {100 * self.left:.1f} % of its response."
        return Card(f"Simulator {self.name}, as a chain of effects", (line,), Frame.of_rows(rows))

    @property
    def values(self) -> dict[str, float]:
        """`T_L` [s], `K_L`, and `effect.parameter` of the effects it has."""
        own = {"T_L": float(self.surrogate.plant.T_L), "K_L": float(self.surrogate.plant.K_L)}
        report = self.surrogate.plant.report()
        return own | {f"{e}.{k}": float(x) for e, values in report.items() for k, x in values.items() if x.dim() == 0}

    @property
    def left(self) -> float:
        """Share of its response that no chain of known effects gives, of the channel where it is largest."""
        return max(self.surrogate.left.values())

    def __str__(self) -> str:
        lines = [f"{self.name} answers as"]
        for name, value in self.values.items():
            effect, _, key = name.rpartition(".")
            unit = {"T_L": "s", "K_L": "-"}.get(key) if not effect else unit_of(key)
            words = f"{effect}: {words_of(key)}" if effect else {"T_L": "lag T_L", "K_L": "gain K_L"}[key]
            lines.append(f"  {words} {value:.3g}{'' if unit == '-' else f' {unit}'}")
        return "\n".join([*lines, f"and that is all but {100 * self.left:.1f} % of its response."])

    def to_dict(self) -> dict[str, Any]:
        """As `simulator.json`."""
        return {
            "schema": "avtorch.simulator/1",
            "name": self.name,
            "values": self.values,
            "left": dict(self.surrogate.left),
        }


def check_simulator(
    simulator: Simulator,
    *,
    name: str = "",
    speeds: Sequence[float] = SPEEDS_MPS,
    step_s: float = STEP_S,
) -> SimulatorCheck:
    """What `simulator` does, from drives that begin at `speeds` [m/s], with steps of `step_s` [s].

    Raises `InputError` for an object that is no simulator, one that fails (see `driven_along`), a step or speeds out of
    range, and one that does not respond.

    Example:
        >>> from avtorch import InputError
        >>> from avtorch.external import check_simulator
        >>> class Parked:
        ...     def reset(self, *, speed, accel): pass
        ...     def step(self, accel_cmd, dt): return 0.0, 0.0
        >>> try:
        ...     check_simulator(Parked())
        ... except InputError as error:
        ...     print(error)
        Parked: does not respond to commands between -2.5 and 2.5 m/s²
    """
    if not isinstance(simulator, Simulator):
        raise InputError(
            f"simulator: found {type(simulator).__name__}, needs reset(speed, accel) and step(accel_cmd, dt)"
        )
    if not 0.001 <= step_s <= 0.1:
        raise InputError(f"step_s: found {step_s}, needs 0.001 to 0.1 s")
    if not speeds or not all(np.isfinite(v) and v >= 5 for v in speeds):
        raise InputError(f"speeds: found {list(speeds)}, needs one or more of 5 m/s or above")
    name = name or type(simulator).__name__
    command = _manoeuvre(step_s)
    rows = len(command)
    time = np.concatenate([k * (rows * step_s + 60.0) + step_s * np.arange(rows) for k in range(len(speeds))])
    drive = Log.from_arrays(
        name=name,
        time=time,
        accel_cmd=np.tile(command, len(speeds)),
        accel=np.zeros(len(time)),
        speed=np.repeat(np.asarray(speeds, float), rows),
    )
    output = driven_along(simulator, drive, name=name)
    if output.accel is None or output.accel.std() < 1e-6:
        raise InputError(
            f"{name}: does not respond to commands between {command.min():.2g} and {command.max():.2g} m/s²"
        )
    return SimulatorCheck(name, surrogate_of([output], enough=_ENOUGH), output)


def _manoeuvre(dt: float) -> FloatArray:
    """Commands (row,) [m/s²]: a sweep, and steps of every size; what is gained in speed is lost again."""
    time = dt * np.arange(round(_SWEEP_S / dt))
    low, high = _SWEEP_HZ
    phase = 2 * np.pi * low * _SWEEP_S / np.log(high / low) * ((high / low) ** (time / _SWEEP_S) - 1)
    pieces = [np.zeros(round(_REST_S / dt)), np.sin(phase)]
    for size in _STEPS:
        pieces += [np.zeros(round(_REST_S / dt)), np.full(round(_HOLD_S / dt), size)]
    return np.concatenate([*pieces, np.zeros(round(_REST_S / dt))])
