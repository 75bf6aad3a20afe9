"""A simulator of the user's as the baseline of a diagnosis: by its output, or driven along the car's commands."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, field, replace
from typing import Any, Protocol, TypeVar, cast, runtime_checkable

from avtorch.errors import InputError, listed, quoted
from avtorch.external.adjusting import Adjusted, Rollouts, adjusted, fewest_rollouts
from avtorch.external.answer import lag_and_gain, responses, rollout_errors, with_simulator, without_discrepancy
from avtorch.external.driving import aligned, driven_along, in_drives
from avtorch.external.simulator import Limits, Simulator, values_of, with_values
from avtorch.external.surrogate import Surrogate, surrogate_of
from avtorch.gap.result.diagnosis import Diagnosis
from avtorch.gap.simulator.plant import GapPlant
from avtorch.io import Log
from avtorch.vehicle.plant import GLVDPlant

Progress = Callable[[str, int, int], None]
Values = Mapping[str, float]
Answer = TypeVar("Answer")
_MOST_PROCESSES = 64
_copied: tuple[Simulator, Callable[[Simulator, Values], Any]] | None = None
"""What a copy of this process drives."""


@dataclass(frozen=True, eq=False)
class ExternalSimulator:
    """A simulator that is not avtorch's own, for `avtorch.diagnose(logs, baseline=...)`.

    `of`: its output under the car's commands, a log (or one for each of the car's drives), or the simulator itself: an
    object with `reset` and `step` (`Simulator`), or a class of such. `name`: what it is called in the answer. `step_s`:
    its own step [s], where it takes no other. `adjustable`: lowest and highest value of each of its parameters that may
    be wrong, see `avtorch.external.simulator.values_of`; these are fitted to the car, with at most `most_rollouts`
    drives through its log, in so many `processes`, and the diagnosis is of the simulator with the car's values.

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
    adjustable: Limits = field(default_factory=dict)
    most_rollouts: int = 50
    processes: int = 1

    def __post_init__(self) -> None:
        found: Any = self.of() if isinstance(self.of, type) and callable(getattr(self.of, "step", None)) else self.of
        if isinstance(found, GapPlant | GLVDPlant):  # it has methods of these names, for closed loops
            given = "baseline=plant" if isinstance(found, GapPlant) else 'baseline="T_L=0.3, K_L=1"'
            raise InputError(f"simulator: found a plant of avtorch's own, which is a baseline itself: pass {given}")
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
        if not (isinstance(self.processes, int) and 1 <= self.processes <= _MOST_PROCESSES):
            raise InputError(f"processes: found {self.processes!r}, needs a number from 1 to {_MOST_PROCESSES}")
        if self.adjustable:
            if isinstance(found, tuple):
                raise InputError("adjustable: has no meaning for an output, needs the simulator itself")
            values_of(cast("Simulator", found), self.adjustable)
            if self.most_rollouts < fewest_rollouts(self.adjustable):
                needed = f"{fewest_rollouts(self.adjustable)} or more to adjust {listed(self.adjustable)}"
                raise InputError(f"most_rollouts: found {self.most_rollouts}, needs {needed}")
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
        if not self.adjustable:
            outputs, offsets = self.outputs(logs, progress)
            return _beside(self, logs, outputs, offsets, rollout_errors(logs, outputs), None, None, progress)
        rollouts = self._rollouts(logs, progress)
        first = rollouts.at(rollouts.start)
        fitted = adjusted(rollouts, self.adjustable)
        outputs = fitted.outputs if fitted.wrong else first
        offsets = (0.0,) * len(logs)
        return _beside(self, logs, outputs, offsets, rollout_errors(logs, first), rollouts, fitted, progress)

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
        return self._driven(self.of, logs, progress), (0.0,) * len(logs)

    def _driven(self, car: Simulator, logs: Sequence[Log], progress: Progress | None = None) -> tuple[Log, ...]:
        own, step_s = self.name, self.step_s
        return tuple(driven_along(car, log, name=own, step_s=step_s, progress=progress) for log in logs)

    def _rollouts(self, logs: Sequence[Log], progress: Progress | None) -> Rollouts:
        """Drives of the simulator by the values of its adjustable parameters."""
        simulator = cast("Simulator", self.of)

        def one(own: Simulator, values: Values) -> tuple[Log, ...]:
            return self._driven(with_values(own, values), logs)

        def drive(places: Sequence[Values]) -> list[tuple[Log, ...]]:
            first = not len(rollouts)  # by which it is told how long the others take
            if progress is not None and not first:
                each = rollouts.seconds / len(rollouts)
                many = f"{len(rollouts) + len(places)} of {self.most_rollouts} at most"
                progress(f"fitting its parameters, drive {many}, {each:.2g} s each", len(rollouts), self.most_rollouts)
            if first and len(places) == 1:
                return [self._driven(simulator, logs, progress)]
            return side_by_side(simulator, one, places, self.processes)

        rollouts = Rollouts(logs, values_of(simulator, self.adjustable), drive, self.most_rollouts)
        return rollouts


@dataclass(frozen=True, eq=False)
class SimulatorBesideCar:
    """A diagnosis against `simulator`: that of `logs` with `plant` as its baseline.

    `outputs`: the simulator's. `logs`: the car's, less what the simulator does beyond its surrogate. `fitted`: its own
    parameters fitted to the car, where it may adjust any.
    """

    simulator: ExternalSimulator
    surrogate: Surrogate
    outputs: tuple[Log, ...]
    logs: tuple[Log, ...]
    offsets: tuple[float, ...]
    rollout: dict[str, float]
    rollouts: Rollouts | None = None
    fitted: Adjusted | None = None

    @property
    def plant(self) -> GapPlant:
        """The simulator's surrogate."""
        return self.surrogate.plant

    def told(self, found: Diagnosis) -> Diagnosis:
        """The diagnosis, with what it says of the simulator."""
        out = self._told(found)
        if self.fitted is None or out.tested is None or found.plant is None or not out.tested.missing:
            return out
        # without what is missing its parameters stood in for that
        assert self.rollouts is not None
        missing = set(out.tested.missing)
        rest = [effect for effect in found.plant.effects if effect.name not in missing]
        bare = GapPlant(rest, T_L=found.plant.T_L, K_L=found.plant.K_L, sigma=0.0)
        logs = self.rollouts.logs
        cars = [_without(*each, found.plant, bare) for each in zip(logs, self.outputs, strict=True)]
        fitted = adjusted(self.rollouts, self.simulator.adjustable, logs=cars)
        outputs = fitted.outputs if fitted.wrong else self.rollouts.at(self.rollouts.start)
        again = _beside(self.simulator, logs, outputs, self.offsets, self.rollout, self.rollouts, fitted)
        return again._told(found)

    def _told(self, found: Diagnosis) -> Diagnosis:
        return with_simulator(
            found,
            self.surrogate,
            name=self.simulator.name,
            source="simulator" if self.simulator.output is None else "output",
            offset_s=self.offsets,
            rollout=self.rollout,
            own_parameters=() if self.fitted is None else self.fitted.parameters,
            lag_and_gain=lag_and_gain(self.logs, self.outputs, self.plant, found),
            rollouts=0 if self.fitted is None else self.fitted.rollouts,
            notes=tuple(getattr(self.simulator.of, "notes", ())),
        )


def _without(log: Log, drives: Log, car: GapPlant, bare: GapPlant) -> Log:
    """The car's log less what it does beyond a `bare` one."""
    whole, less = responses(drives, car), responses(drives, bare)
    return replace(log, **{n: getattr(log, n) - whole[n] + less[n] for n in whole if getattr(log, n) is not None})


def _beside(
    simulator: ExternalSimulator,
    logs: Sequence[Log],
    outputs: Sequence[Log],
    offsets: tuple[float, ...],
    errors: dict[str, float],
    rollouts: Rollouts | None,
    fitted: Adjusted | None,
    progress: Progress | None = None,
) -> SimulatorBesideCar:
    """With the surrogate of these `outputs`, and the car's logs less what it leaves over."""
    surrogate = surrogate_of(outputs, progress=progress)
    cars = [replace(log, engaged=other.engaged) for log, other in zip(logs, outputs, strict=True)]
    freed = tuple(without_discrepancy(log, other, surrogate.plant) for log, other in zip(cars, outputs, strict=True))
    return SimulatorBesideCar(simulator, surrogate, tuple(outputs), freed, offsets, errors, rollouts, fitted)


@runtime_checkable
class Apart(Protocol):
    """A simulator that runs in a process of its own and can be had in another; an `FmuSimulator` is one."""

    def apart(self) -> Simulator: ...

    def close(self) -> None: ...


def side_by_side(
    simulator: Simulator, call: Callable[[Simulator, Values], Answer], each: Sequence[Values], processes: int
) -> list[Answer]:
    """`call(simulator, values)` for each of the values, in order, at most `processes` at once: an FMU in more processes
    of its own, an object in copies of this one, or one after another where the system cannot copy a process (Windows).

    Raises what a call raises.
    """
    count = min(processes, len(each))
    if isinstance(simulator, Apart) and count > 1:
        others = [simulator.apart() for _ in range(count)]
        shares = [each[n::count] for n in range(count)]
        try:
            with ThreadPoolExecutor(count) as pool:
                found = list(pool.map(lambda own, share: [call(own, values) for values in share], others, shares))
        finally:
            for own in others:
                own.close()  # type: ignore[attr-defined]
        return [found[k % count][k // count] for k in range(len(each))]
    if count < 2 or "fork" not in multiprocessing.get_all_start_methods():
        return [call(simulator, values) for values in each]
    # a copy of the process has the simulator, which need not be one that can be sent
    copies = multiprocessing.get_context("fork")
    try:
        with ProcessPoolExecutor(count, copies, _take_over, (simulator, call)) as pool:
            return list(pool.map(_called, each))
    except BrokenProcessPool:
        raise InputError("simulator: ended the process that drove it") from None


def _take_over(simulator: Simulator, call: Callable[[Simulator, Values], Any]) -> None:
    global _copied
    _copied = simulator, call


def _called(values: Values) -> Any:
    assert _copied is not None
    simulator, call = _copied
    return call(simulator, values)
