"""A simulator of the user's as the baseline of a diagnosis: by its output, or driven along the car's commands.

Let S be the simulator, M its surrogate, and y what the car did under the same commands. The simulator predicts y as

    S(u) = M(u) + d,   d = S(u) - M(u),

so the gap between car and simulator is that between `y - d` and the chain M. A diagnosis with M as its baseline, of a
log from which `d` is subtracted, is a diagnosis of the simulator; `d` is known row by row and needs no model. Effects
and parameters are then asked of M: exact where they act on the output (sensors, forces), where they commute with the
rest of the simulator (a delay), or where M holds what they do not commute with; else to first order in `d`, which is
small where the surrogate is good.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, cast

import numpy as np
import torch

from avtorch.arrays import FloatArray
from avtorch.errors import InputError, listed, quoted
from avtorch.external.adjusting import Rollouts, adjusted, fewest_rollouts
from avtorch.external.driving import aligned, driven_along, in_drives, side_by_side
from avtorch.external.simulator import DrivenPlant, Limits, Simulator, Values, check_methods, values_of, with_values
from avtorch.external.surrogate import Surrogate, surrogate_of
from avtorch.gap.linearised import linearised
from avtorch.gap.quantity import Quantity
from avtorch.gap.result.diagnosis import Diagnosis
from avtorch.gap.result.simulator_under_test import SAME_KIND, ParameterDifference, SimulatorUnderTest
from avtorch.gap.simulator.plant import GapPlant
from avtorch.gap.simulator.simulator_input import SimulatorInput
from avtorch.io import Log
from avtorch.vehicle.plant import GLVDPlant

Progress = Callable[[str, int, int], None]
_MOST_PROCESSES = 64


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
        else:
            check_methods(found, quoted(found.__name__ if isinstance(found, type) else type(found).__name__))
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
            surrogate = surrogate_of(outputs, progress=progress)
            return SimulatorBesideCar(self, logs, outputs, surrogate, offsets, rollout_errors(logs, outputs))
        rollouts, offsets = self._rollouts(logs, progress), (0.0,) * len(logs)
        outputs, own = adjusted(rollouts, self.adjustable)
        errors = rollout_errors(logs, rollouts.at(rollouts.start))
        surrogate = surrogate_of(outputs, progress=progress)
        return SimulatorBesideCar(self, logs, outputs, surrogate, offsets, errors, own, rollouts)

    def outputs(
        self, logs: Sequence[Log], progress: Progress | None = None
    ) -> tuple[tuple[Log, ...], tuple[float, ...]]:
        """Its output in the rows of each log, and what its clock was ahead of the log's [s]. Raises as `beside`."""
        if self.output is not None:
            if len(self.output) != len(logs):
                raise InputError(f"simulated: found {len(self.output)} logs for {len(logs)} drives, needs one for each")
            found = [aligned(other, log) for other, log in zip(self.output, logs, strict=True)]
            driven = tuple(in_drives(output, log) for (output, _), log in zip(found, logs, strict=True))
            return driven, tuple(offset for _, offset in found)
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
            if progress is not None:
                many = f"{len(rollouts) + len(places)} of {self.most_rollouts} at most"
                progress(f"fitting its parameters, drive {many}", len(rollouts), self.most_rollouts)
            return side_by_side(simulator, one, places, self.processes)

        rollouts = Rollouts(logs, values_of(simulator, self.adjustable), drive, self.most_rollouts)
        return rollouts


@dataclass(frozen=True, eq=False)
class SimulatorBesideCar:
    """A diagnosis against `simulator`: that of `logs` with `plant` as its baseline.

    `cars`: the car's logs. `outputs`: the simulator's. `rollout`: its errors, before anything is fitted. `own`: its own
    parameters fitted to the car by `rollouts`, where it may adjust any.
    """

    simulator: ExternalSimulator
    cars: Sequence[Log]
    outputs: tuple[Log, ...]
    surrogate: Surrogate
    offsets: tuple[float, ...]
    rollout: dict[str, float]
    own: tuple[ParameterDifference, ...] = ()
    rollouts: Rollouts | None = None

    @property
    def logs(self) -> tuple[Log, ...]:
        """The car's, less what the simulator does beyond its surrogate."""
        cars = [replace(log, engaged=out.engaged) for log, out in zip(self.cars, self.outputs, strict=True)]
        return tuple(less(log, out, discrepancy(out, self.plant)) for log, out in zip(cars, self.outputs, strict=True))

    @property
    def plant(self) -> GapPlant:
        """The simulator's surrogate."""
        return self.surrogate.plant

    def told(self, found: Diagnosis) -> Diagnosis:
        """The diagnosis, with what it says of the simulator."""
        out = self._told(found)
        if self.rollouts is None or out.tested is None or found.plant is None or not out.tested.missing:
            return out
        # without what is missing its parameters stood in for that
        missing = set(out.tested.missing)
        rest = [effect for effect in found.plant.effects if effect.name not in missing]
        bare = GapPlant(rest, T_L=found.plant.T_L, K_L=found.plant.K_L, sigma=0.0)
        cars = []
        for log, out in zip(self.cars, self.outputs, strict=True):
            whole, without = responses(out, found.plant), responses(out, bare)
            cars.append(less(log, out, {name: values - without[name] for name, values in whole.items()}))
        outputs, own = adjusted(self.rollouts, self.simulator.adjustable, logs=cars)
        return replace(self, outputs=outputs, surrogate=surrogate_of(outputs), own=own)._told(found)

    def _told(self, found: Diagnosis) -> Diagnosis:
        chain = self.plant
        own = chain.report()
        differences = [*self.own, *lag_and_gain(self.logs, self.outputs, chain, found)]
        # what chance decides is in no rollout, and so in no simulator
        by_chance = set() if found.budget is None else {part.name for part in found.budget.chance}
        missing = [
            effect
            for effect in found.verdict.names
            if effect not in ("none", "unknown") and effect not in by_chance and not _of_a_size(found, effect, chain)
        ]
        for effect in found.verdict.names:
            for key, car in _parameters(found, effect).items() if effect in own else ():
                if key in own[effect]:
                    value = float(own[effect][key])
                    wrong = effect not in missing and not car.q05 <= value <= car.q95
                    differences.append(ParameterDifference(f"{effect}.{key}", value, car, wrong))
        facts = SimulatorUnderTest(
            self.simulator.name,
            "simulator" if self.simulator.output is None else "output",
            self.offsets,
            chain,
            self.surrogate.left,
            self.rollout,
            tuple(differences),
            tuple(missing),
            0 if self.rollouts is None else len(self.rollouts),
        )
        return replace(found, tested=facts, notes=(*found.notes, *getattr(self.simulator.of, "notes", ())))


def responses(drives: Log, plant: GapPlant) -> dict[str, FloatArray]:
    """What `plant` does in `drives` by the channels that these have, (time,): acceleration [m/s²] and speed [m/s], anew
    from each segment's first row. Rows under the driver keep what is there."""
    found = {name: values.copy() for name in ("accel", "speed") if (values := getattr(drives, name)) is not None}
    assert drives.accel_cmd is not None
    for segment in range(int(drives.segment[-1]) + 1):
        rows = drives.segment == segment
        if rows.sum() < 2 or not drives.engaged[rows].any():  # under the driver there is no simulator
            continue
        time, command = torch.as_tensor(drives.elapsed[rows]), torch.as_tensor(drives.accel_cmd[rows])
        speed = None if drives.speed is None else torch.as_tensor(drives.speed[rows])
        accel0 = None if drives.accel is None else float(drives.accel[rows][0])
        response = plant.response(SimulatorInput(time, command, speed, accel0, drives.accel_kind == "specific-force"))
        answers = {"accel": response.accel_measured, "speed": response.speed_measured}
        for name, values in found.items():
            values[rows] = answers[name].numpy()
    return found


def discrepancy(simulated: Log, surrogate: GapPlant) -> dict[str, FloatArray]:
    """`d` by channel, (time,): acceleration [m/s²] and, from each segment's start, speed [m/s]."""
    return {name: getattr(simulated, name) - values for name, values in responses(simulated, surrogate).items()}


def less(log: Log, simulated: Log, beyond: Mapping[str, FloatArray]) -> Log:
    """The car's `log` less what is `beyond`, row by row, in the channels that the output `simulated` has, too.

    Raises `InputError` where it has none of the log's.
    """
    channels = {name: getattr(log, name) for name in ("accel", "speed") if getattr(log, name) is not None}
    shared = {name: values - beyond[name] for name, values in channels.items() if name in beyond}
    if not shared:
        raise InputError(f"{simulated.name}: found {' and '.join(beyond)}, needs {' or '.join(channels)} as {log.name}")
    return replace(log, **{name: shared.get(name) for name in channels})


def lateness(plant: GapPlant, speed: float) -> float:
    """Delay [s] of the measured acceleration behind slow commands, at a speed [m/s]: `T_L` for GLVD, and the sum of the
    delays of all that the command passes. At least `T_L`, also for a plant that does not answer a step of 0.5 m/s²."""
    chain = linearised(plant, speed=max(speed, 1.0))
    answer = chain.motion[0, 0] * chain.sensed[0, 0]
    return max(-float(answer.angle()) / float(chain.omega[0]), float(plant.T_L))


HORIZON_S = 10.0
_FARTHEST = 4.0  # times as large or small, that lag and gain may be on the car
_MATERIAL = {"T_L": 0.1, "K_L": 0.03}  # difference that a controller notices, of how late the car answers and of K_L


def rollout_errors(logs: Sequence[Log], simulated: Sequence[Log]) -> dict[str, float]:
    """Root mean squared error of the simulator's output as it is, by channel: acceleration [m/s²], and the speed that
    it gains within 10 s [m/s], over usable rows.
    """
    errors: dict[str, list[FloatArray]] = {}
    for log, other in zip(logs, simulated, strict=True):
        usable = log.usable & other.engaged
        for part in other.engaged_segments():
            if log.accel is not None and other.accel is not None:
                errors.setdefault("accel", []).append((other.accel - log.accel)[part][usable[part]])
            if log.speed is not None and other.speed is not None:
                rows = max(1, round(HORIZON_S * log.rate_hz))
                for begin in range(part.start, part.stop, rows):
                    own = slice(begin, min(begin + rows, part.stop))
                    away = (other.speed - log.speed)[own]
                    errors.setdefault("speed", []).append((away - away[0])[usable[own]])
    joined = {name: np.concatenate(parts) for name, parts in errors.items()}
    return {name: float(np.sqrt(np.mean(x**2))) for name, x in joined.items() if len(x)}


def lag_and_gain(
    logs: Sequence[Log], outputs: Sequence[Log], surrogate: GapPlant, found: Diagnosis
) -> list[ParameterDifference]:
    """T_L and K_L of the `surrogate`, with the effects that were `found`, fitted to the car's `logs`.

    They differ as the simulator's own parameters do (`adjusted`), by more than a controller notices, and where the
    likelihood, another engine, finds them away to the same side: each has a weak place of its own, the one where an
    effect's size trades with the gain, the other where a recorder colours the noise. What a controller notices of a lag
    is how much later the car answers, of all its lateness.
    """
    before = {name: float(getattr(surrogate, name)) for name in _MATERIAL}
    car = surrogate if found.plant is None else found.plant

    def drive(places: Sequence[Mapping[str, float]]) -> list[list[Log]]:
        others = [GapPlant(car.effects, T_L=values["T_L"], K_L=values["K_L"], sigma=0.0) for values in places]
        return [[replace(out, **responses(out, other)) for out in outputs] for other in others]

    limits = {name: (x / _FARTHEST, x * _FARTHEST) for name, x in before.items()}
    try:
        _, fitted = adjusted(Rollouts(logs, before, drive, most=100), limits)
    except InputError:  # a drive too short for blocks to be held out
        return []
    likely = {**found.baseline, **found.winner.moved}  # which have lag and gain only where these were fitted
    speeds = [log.speed[log.usable].mean() for log in logs if log.speed is not None and log.usable.any()]
    whole = {"T_L": lateness(surrogate, float(np.mean(speeds)) if speeds else 0.0), "K_L": before["K_L"]}
    return [
        replace(p, own=False, differs=p.differs and _noticed(p, likely.get(p.name, p.car).mean, whole[p.name]))
        for p in fitted
    ]


def _noticed(parameter: ParameterDifference, likely: float, whole: float) -> bool:
    least = _MATERIAL[parameter.name] * whole
    away = [x - parameter.simulator for x in (parameter.car.mean, likely)]
    return min(away) > least or max(away) < -least


def _parameters(found: Diagnosis, effect: str) -> dict[str, Quantity]:
    """Of an effect of the verdict, from the budget's part where there is one."""
    parts = [] if found.budget is None else [p for p in found.budget.parts if p.name == effect]
    if parts:
        return dict(parts[0].parameters)
    alone = found.verdict.names == (effect,)
    keys = {key if alone else key.removeprefix(f"{effect}."): q for key, q in found.winner.parameters.items()}
    return {key: q for key, q in keys.items() if alone or f"{effect}.{key}" in found.winner.parameters}


def _of_a_size(found: Diagnosis, effect: str, simulator: GapPlant) -> bool:
    """Whether the simulator has the effect at about the car's size, so that its parameter may be wrong, and the effect
    is not missing."""
    own = simulator.report().get(effect, {})
    for key, car in _parameters(found, effect).items():
        if key in own:
            return abs(float(own[key])) > SAME_KIND * abs(car.mean)
    return False


class Wrapped:
    """A `Simulator`: another one, and what a car (`car`) does beyond its surrogate (`own`).

    What is added to its output is the difference between the surrogate with and without what was found: what the
    diagnosis itself rolled out. That is exact for effects that commute with the simulator (a delay, a sensor, a force)
    or with which its surrogate commutes as it does. Speed gains what the added acceleration integrates to; the
    simulator's own forces do not learn of it.
    """

    def __init__(self, simulator: Simulator, own: GapPlant, car: GapPlant) -> None:
        self.simulator, self._without, self._with = simulator, DrivenPlant(own), DrivenPlant(car)

    def reset(self, *, speed: float, accel: float) -> None:
        """Begin a drive, see `Simulator.reset`."""
        self.simulator.reset(speed=speed, accel=accel)
        for chain in (self._without, self._with):
            chain.reset(speed=speed, accel=accel)

    def step(self, accel_cmd: float, dt: float) -> tuple[float, float]:
        """Hold the command, see `Simulator.step`."""
        accel, speed = self.simulator.step(accel_cmd, dt)
        with_it, without = self._with.step(accel_cmd, dt), self._without.step(accel_cmd, dt)
        return accel + with_it[0] - without[0], speed + with_it[1] - without[1]


def wrap(simulator: Simulator, found: Diagnosis) -> Wrapped:
    """`simulator` with what `found` says that it lacks, and with the parameters of the car.

    Raises `InputError` for a diagnosis that names nothing and finds no parameter wrong, or of no external simulator.

    Example:
        >>> import numpy as np
        >>> from avtorch import ExternalSimulator, Leader, diagnose, simulate
        >>> from avtorch.external import wrap
        >>> from avtorch.gap import ConstantResistance, plant
        >>> class Mine:
        ...     def reset(self, *, speed, accel):
        ...         self.speed, self.accel = speed, accel
        ...     def step(self, accel_cmd, dt):
        ...         before = self.accel
        ...         self.accel = accel_cmd + np.exp(-dt / 0.3) * (before - accel_cmd)
        ...         self.speed += dt * (before + self.accel) / 2
        ...         return self.accel, self.speed
        >>> car = plant([ConstantResistance(0.3)], T_L=0.3, sigma=0.02)
        >>> log = simulate(Leader.default(start=30.0, duration=40.0, dt=0.05), plant=car).log()
        >>> candidates = ["constant_resistance", "dead_time"]
        >>> found = diagnose(log, baseline=ExternalSimulator(Mine), effects=candidates, pairs=False)
        >>> found.verdict.names
        ('constant_resistance',)
        >>> better = wrap(Mine(), found)
        >>> better.reset(speed=20.0, accel=0.0)
        >>> speed = [better.step(0.0, 0.05)[1] for _ in range(200)][-1]  # it slows down by itself
        >>> bool(16.5 < speed < 17.5)
        True
    """
    if found.tested is None:
        raise InputError("found: is of no external simulator; needs diagnose(logs, baseline=ExternalSimulator(...))")
    if found.plant is None and not found.tested.wrong:
        raise InputError(f"found: the verdict is {found.verdict.name}; there is nothing to put around the simulator")
    own = found.tested.surrogate
    values = {p.name: p.car.mean for p in found.tested.parameters if p.name in ("T_L", "K_L") and not p.own}
    car = own.with_values(values) if found.plant is None else found.plant
    adjusted = {p.name: p.car.mean for p in found.tested.parameters if p.own}
    if any(p.own for p in found.tested.wrong):
        simulator = with_values(simulator, adjusted)
    return Wrapped(simulator, own, car)
