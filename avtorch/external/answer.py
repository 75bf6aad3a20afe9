"""A simulator of the user's against drives of a car: what it lacks, and which of its parameters are wrong.

Let S be the simulator, M its surrogate, and y what the car did under the same commands. The simulator predicts y as

    S(u) = M(u) + d,   d = S(u) - M(u),

so the gap between car and simulator is that between `y - d` and the chain M. A diagnosis with M as its baseline, of a
log from which `d` is subtracted, is a diagnosis of the simulator; `d` is known row by row and needs no model. Effects
and parameters are then asked of M: exact where they act on the output (sensors, forces), where they commute with the
rest of the simulator (a delay), or where M holds what they do not commute with; else to first order in `d`, which is
small where the surrogate is good.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from scipy.integrate import trapezoid

from avtorch.arrays import FloatArray
from avtorch.errors import InputError
from avtorch.external.adjusting import Rollouts, adjusted
from avtorch.external.surrogate import Surrogate
from avtorch.gap.quantity import Quantity
from avtorch.gap.result.diagnosis import Diagnosis
from avtorch.gap.result.simulator_under_test import SAME_KIND, ParameterDifference, SimulatorUnderTest
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
        answers = {"accel": response.accel_measured, "speed": response.speed_measured}
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


_STEP_MPS2, _RATE_HZ = 0.5, 100
_BEFORE_S, _AFTER_S, _SETTLED_S = 1.0, 9.0, 1.0


def lateness(plant: GapPlant, speed: float) -> float:
    """Mean delay [s] of the acceleration that answers a step in the command, at a speed [m/s].

    It is the area between the step and its answer, over the answer's height: `T_L` for GLVD, and the sum of the delays
    of all that the command passes. At least `T_L`, also for a plant that does not answer a step of 0.5 m/s².
    """
    time = np.arange(round((_BEFORE_S + _AFTER_S) * _RATE_HZ)) / _RATE_HZ
    step = np.where(time < _BEFORE_S, 0.0, _STEP_MPS2)
    still = 0.0 * time

    def accel(command: FloatArray) -> FloatArray:
        drive = Log.from_arrays(time=time, accel_cmd=command, accel=still, speed=still + max(speed, 1.0))
        return responses(drive, plant)["accel"]

    # without the forces that act whatever the command
    answer = accel(step) - accel(still)
    height = float(answer[-round(_SETTLED_S * _RATE_HZ) :].mean())
    least = float(plant.T_L)
    if abs(height) < 1e-3 * _STEP_MPS2:
        return least
    after = time >= _BEFORE_S
    return max(float(trapezoid(1.0 - answer[after] / height, dx=1 / _RATE_HZ)), least)


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


def with_simulator(
    found: Diagnosis,
    surrogate: Surrogate,
    *,
    name: str,
    source: str,
    offset_s: Sequence[float],
    rollout: dict[str, float],
    own_parameters: Sequence[ParameterDifference],
    lag_and_gain: Sequence[ParameterDifference],
    rollouts: int,
    notes: Sequence[str],
) -> Diagnosis:
    """`found`, a diagnosis with the surrogate as its baseline, with what it says of the simulator itself."""
    own = surrogate.plant.report()
    named = [n for n in found.verdict.names if n in own]
    differences = [*own_parameters, *lag_and_gain]
    missing = []
    # what chance decides is in no rollout, and so in no simulator
    by_chance = set() if found.budget is None else {part.name for part in found.budget.chance}
    for effect in found.verdict.names:
        if effect in ("none", "unknown") or effect in by_chance:
            continue
        if effect not in own or not _of_a_size(found, effect, surrogate):
            missing.append(effect)
    for effect in named:
        wrong = effect not in missing
        for key, car in _parameters(found, effect).items():
            if key in own[effect]:
                value = float(own[effect][key])
                differences.append(ParameterDifference(f"{effect}.{key}", value, car, wrong and not _holds(car, value)))
    facts = SimulatorUnderTest(
        name,
        source,
        tuple(offset_s),
        surrogate.plant,
        surrogate.left,
        rollout,
        tuple(differences),
        tuple(missing),
        rollouts,
    )
    return replace(found, tested=facts, notes=(*found.notes, *notes))


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
        fitted = adjusted(Rollouts(logs, before, drive, most=100), limits)
    except InputError:  # a drive too short for blocks to be held out
        return []
    likely = {**found.baseline, **found.winner.moved}  # which have lag and gain only where these were fitted
    speeds = [log.speed[log.usable].mean() for log in logs if log.speed is not None and log.usable.any()]
    whole = {"T_L": lateness(surrogate, float(np.mean(speeds)) if speeds else 0.0), "K_L": before["K_L"]}
    return [
        replace(p, own=False, differs=p.differs and _noticed(p, likely.get(p.name, p.car).mean, whole[p.name]))
        for p in fitted.parameters
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


def _of_a_size(found: Diagnosis, effect: str, surrogate: Surrogate) -> bool:
    """Whether the simulator's own effect and the car's are of one size, so that its parameter is wrong, and the effect
    not missing."""
    own = surrogate.plant.report()[effect]
    for key, car in _parameters(found, effect).items():
        if key in own:
            return abs(float(own[key])) > SAME_KIND * abs(car.mean)
    return False


def _holds(car: Quantity, value: float) -> bool:
    return car.q05 <= value <= car.q95
