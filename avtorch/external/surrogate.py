"""A chain of effects that answers as a simulator does: its surrogate.

A simulator whose inside is unknown is identified by its own output, as a car is; but it has no noise, so what decides
is least squares, and how much of the response is left to explain. The surrogate stands in for the simulator wherever
one has to ask what it would have done with another parameter or with an effect more; what it leaves over is known, and
stays the simulator's own (`discrepancy`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from avtorch.arrays import FloatArray
from avtorch.gap.budget.analysis_record import AnalysisRecord
from avtorch.gap.budget.effect_model import EffectModel
from avtorch.gap.budget.noise_whitening import NoiseWhitening
from avtorch.gap.budget.repaired_model import plant_of
from avtorch.gap.budget.robust_fit import Fit, RobustFit
from avtorch.gap.budget.score_test import ScoreTest
from avtorch.gap.simulator.effect import EFFECTS, Effect
from avtorch.gap.simulator.plant import GapPlant, plant
from avtorch.io import Log

MOST_EFFECTS = 8
ENOUGH = 0.002
"""Share of the response (root mean square) that may be left over."""
_WORTH = 0.95  # of the errors on blocks held out, that an effect must leave at most
_PER_PARAMETER = 1.5  # times smaller errors, that a parameter more has to be worth when two effects compete
_FITTED, _HELD_OUT = 8, 3  # effects fitted, those of which a score test promises most, and held out of these
_LAGS = (-2.0, -1.0, 0.0, 1.0)  # prior standard deviations
_FIRST_ERROR = 0.1  # of the response
_LEAST_ERROR = 1e-5  # of the response, so that a perfect fit has a scale


@dataclass(frozen=True)
class Surrogate:
    """`plant`: the chain that answers as the simulator does; `left`: share of the response that it does not, by channel
    (root mean squares, of acceleration and of the derivative of speed, below 20 Hz)."""

    plant: GapPlant
    left: Mapping[str, float]


def surrogate_of(
    simulated: Sequence[Log],
    *,
    enough: float = ENOUGH,
    progress: Callable[[str, int, int], None] | None = None,
) -> Surrogate:
    """The surrogate of the simulator whose output these logs are.

    `enough`: share of the response that may be left over.
    `progress(what, done, of)` is called at each effect.

    Raises `InputError` where the drives are too short, see `AnalysisRecord.for_budget`.

    Example:
        >>> from avtorch import Leader, simulate
        >>> from avtorch.external.surrogate import surrogate_of
        >>> from avtorch.gap import DeadTime, plant
        >>> late = plant([DeadTime(0.3)], T_L=0.5, sigma=0.0)
        >>> output = simulate(Leader.default(start=30.0, duration=60.0, dt=0.05), plant=late).log()
        >>> found = surrogate_of([output])
        >>> {name: round(float(x), 2) for name, x in found.plant.values().items()}
        {'T_L': 0.5, 'K_L': 1.0, 'dead_time.delay_s': 0.3}
    """
    record = AnalysisRecord.for_budget(simulated)
    size = record.measured[:, record.counts].std(-1) + 1e-9
    bare = EffectModel(record, plant([], sigma=0.0))
    starts = np.array([bare.coordinates({"T_L": np.array(lag)}) for lag in _LAGS])
    now = _fitting(record, _FIRST_ERROR * size).fit(bare, starts, iterations=15)
    for number in range(MOST_EFFECTS):
        if progress is not None:
            progress("simulator", number, MOST_EFFECTS)
        if (_errors(now) < enough * size).all():
            break
        fitting = _fitting(record, np.maximum(_errors(now), _LEAST_ERROR * size))
        now = fitting.fit(now.model, now.z[None])
        entered = _entered(fitting, now, _kinds(record))
        if entered is None:
            break
        now = entered
    now = _without_the_idle(record, now, size, enough)
    left = dict(zip(record.channels, (_errors(now) / size).tolist(), strict=True))
    return Surrogate(plant_of(now, bare.base), left)


def _kinds(record: AnalysisRecord) -> list[type[Effect]]:
    """Effects that a simulator can have: the same on every drive, by no chance, and seen in these channels."""
    return [
        kind
        for kind in EFFECTS.values()
        if not (kind.random or kind.of_the_drive or kind.own_onset)
        and (record.has_speed or not kind.needs_speed)
        and (kind.place != "sensor" or len(record.channels) == 2)
    ]


def _fitting(record: AnalysisRecord, sd: FloatArray) -> RobustFit:
    """Least squares in which each channel's errors have this size (channel,) and no colour."""
    return RobustFit(NoiseWhitening.of(record, np.ones((len(record.channels), 1)), sd))


def _errors(fit: Fit) -> FloatArray:
    """(channel,) [m/s²], root mean square."""
    return np.sqrt((fit.residuals[:, fit.model.record.counts] ** 2).mean(-1))


def _held_out(fitting: RobustFit, fit: Fit) -> float:
    return float(np.sqrt((fitting.hold_out(fit).white ** 2).mean()))


def _entered(fitting: RobustFit, now: Fit, kinds: Sequence[type[Effect]]) -> Fit | None:
    """The model with the effect that leaves least on blocks held out; an effect with more parameters has to leave
    less for each. None where no effect is worth it."""
    before = _held_out(fitting, now)
    test = ScoreTest.at(fitting, now)
    candidates = [test.candidate(kind) for kind in kinds if kind.name not in now.model.names]
    candidates.sort(key=lambda candidate: -candidate.promise)
    rough = [fitting.fit(c.model, c.starts, iterations=4) for c in candidates[:_FITTED]]
    fits = [fitting.fit(f.model, f.z[None], iterations=12) for f in sorted(rough, key=lambda f: f.nats)[:_HELD_OUT]]
    left = [_held_out(fitting, fit) / before for fit in fits]
    worth = [(share * _PER_PARAMETER**fit.model.size, n) for n, (share, fit) in enumerate(zip(left, fits, strict=True))]
    worth = [(value, n) for value, n in worth if left[n] < _WORTH]
    return fits[min(worth)[1]] if worth else None


def _without_the_idle(record: AnalysisRecord, now: Fit, size: FloatArray, enough: float) -> Fit:
    """The model without effects that the others make superfluous, the most superfluous first."""
    while now.model.names:
        errors = np.maximum(_errors(now), _LEAST_ERROR * size)
        fitting = _fitting(record, errors)
        without = []
        for name in now.model.names:
            model = now.model.without(name)
            without.append(fitting.fit(model, model.coordinates(now.known)[None], iterations=8))
        cost = [float((_errors(fit) / np.maximum(errors, enough * size)).max()) for fit in without]
        if min(cost) > 1 / _WORTH:
            break
        now = without[int(np.argmin(cost))]
    return now
