"""A simulator of the user's as the baseline of a diagnosis: by its output, or driven along the car's commands."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

from avtorch.errors import InputError, quoted
from avtorch.external.alignment import aligned
from avtorch.external.answer import rollout_errors, with_simulator
from avtorch.external.discrepancy import without_discrepancy
from avtorch.external.drives import in_drives
from avtorch.external.driving import driven_along
from avtorch.external.simulator import Simulator
from avtorch.external.surrogate import Surrogate, surrogate_of
from avtorch.gap.result.diagnosis import Diagnosis
from avtorch.gap.simulator.plant import GapPlant
from avtorch.io import Log

Progress = Callable[[str, int, int], None]


@dataclass(frozen=True, eq=False)
class ExternalSimulator:
    """A simulator that is not avtorch's own, for `avtorch.diagnose(logs, baseline=...)`.

    `of`: its output under the car's commands, a log (or one for each of the car's drives), or the simulator itself: an
    object with `reset` and `step` (`Simulator`), or a class of such. `name`: what it is called in the answer. `step_s`:
    its own step [s], where it takes no other.

    Raises `InputError` for anything else.

    Example:
        >>> from avtorch import ExternalSimulator, InputError, Leader, diagnose, simulate
        >>> from avtorch.gap import ConstantResistance, DeadTime, plant
        >>> car = plant([DeadTime(0.2), ConstantResistance(0.3)], sigma=0.02)
        >>> log = simulate(Leader.default(start=30.0, duration=60.0, dt=0.05), plant=car).log()
        >>> mine = simulate(Leader.default(start=30.0, duration=60.0, dt=0.05), plant=plant([DeadTime(0.2)], sigma=0.0))
        >>> output = ExternalSimulator(mine.log())
        >>> try:
        ...     diagnose(log, baseline=output)  # its commands were those of another drive
        ... except InputError as error:
        ...     print(str(error).partition(", in an")[0][-25:])
        by the car's own commands
    """

    of: Log | Sequence[Log] | Simulator | type
    name: str = ""
    step_s: float | None = None

    def __post_init__(self) -> None:
        found: Any = self.of() if isinstance(self.of, type) and callable(getattr(self.of, "step", None)) else self.of
        if isinstance(found, Log):
            found = (found,)
        elif isinstance(found, (list, tuple)) and found and all(isinstance(x, Log) for x in found):
            found = tuple(found)
        elif not isinstance(found, Simulator):
            own = found.__name__ if isinstance(found, type) else type(found).__name__
            missing = " and ".join(n for n in ("reset", "step") if not callable(getattr(found, n, None)))
            raise InputError(
                f"simulator: {quoted(own)} has no {missing}; needs reset(speed, accel) and step(accel_cmd, dt)"
            )
        default = found[0].name if isinstance(found, tuple) else type(found).__name__
        object.__setattr__(self, "of", found)
        object.__setattr__(self, "name", self.name or default)

    @property
    def output(self) -> tuple[Log, ...] | None:
        """Its output, where it is given by that."""
        return self.of if isinstance(self.of, tuple) else None

    def beside(self, logs: Sequence[Log], progress: Progress | None = None) -> SimulatorBesideCar:
        """What a diagnosis against it needs. Raises `InputError` where the output does not belong to these drives, or
        the simulator fails under their commands.
        """
        outputs, offsets = self.outputs(logs, progress)
        surrogate = surrogate_of(outputs, progress=progress)
        cars = [replace(log, engaged=other.engaged) for log, other in zip(logs, outputs, strict=True)]
        freed = tuple(
            without_discrepancy(log, other, surrogate.plant) for log, other in zip(cars, outputs, strict=True)
        )
        return SimulatorBesideCar(self, surrogate, freed, offsets, rollout_errors(cars, outputs))

    def outputs(
        self, logs: Sequence[Log], progress: Progress | None = None
    ) -> tuple[tuple[Log, ...], tuple[float, ...]]:
        """Its output in the rows of each log, and what its clock was ahead of the log's [s]. Raises as `beside`."""
        if self.output is not None:
            if len(self.output) != len(logs):
                raise InputError(f"simulated: found {len(self.output)} logs for {len(logs)} drives, needs one for each")
            found = [aligned(other, log) for other, log in zip(self.output, logs, strict=True)]
            driven = tuple(in_drives(x.log, log) for x, log in zip(found, logs, strict=True))
            return driven, tuple(x.offset_s for x in found)
        assert isinstance(self.of, Simulator)
        own, name, step_s = self.of, self.name, self.step_s
        driven = tuple(driven_along(own, log, name=name, step_s=step_s, progress=progress) for log in logs)
        return driven, (0.0,) * len(logs)


@dataclass(frozen=True, eq=False)
class SimulatorBesideCar:
    """A diagnosis against `simulator`: that of `logs` with `plant` as its baseline.

    `logs`: the car's, less what the simulator does beyond its surrogate.
    """

    simulator: ExternalSimulator
    surrogate: Surrogate
    logs: tuple[Log, ...]
    offsets: tuple[float, ...]
    rollout: dict[str, float]

    @property
    def plant(self) -> GapPlant:
        """The simulator's surrogate."""
        return self.surrogate.plant

    def told(self, found: Diagnosis) -> Diagnosis:
        """The diagnosis, with what it says of the simulator."""
        return with_simulator(
            found,
            self.surrogate,
            name=self.simulator.name,
            source="simulator" if self.simulator.output is None else "output",
            offset_s=self.offsets,
            rollout=self.rollout,
            notes=tuple(getattr(self.simulator.of, "notes", ())),
        )
