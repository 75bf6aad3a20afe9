"""Test whether a change to the car or to the simulator helped, from two sets of drives.

The car: `T_L` and `K_L` are fitted to each set, behind a recorder of unknown delay and filter. Their spread between
drives of one car is estimated from the blocks of the drives, each of which contributes its own score (the sandwich
estimator of White 1982), and is never less than the posterior's. Differences that a missing effect causes between
manoeuvres therefore count as spread, not as a change.

The cause: T_L alone, K_L alone, dead time, or an effect of the table, whichever explains the drives after best in one
model of both sides that shares all the rest (`engine.joint`).

The simulator: errors of free runs over both sets, and their ratio over bootstrapped runs.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from os import PathLike

import numpy as np
from scipy.stats import f as fisher  # pyright: ignore[reportMissingTypeStubs]
from scipy.stats import t as student  # pyright: ignore[reportMissingTypeStubs]

from avtorch.arrays import FloatArray
from avtorch.display.progress import called, shows_progress
from avtorch.errors import InputError
from avtorch.gap.engine.drive_data import DriveData
from avtorch.gap.engine.gauss_newton import jacobian, prior_terms, whitened_jacobian
from avtorch.gap.engine.joint import JointModel, block_scores
from avtorch.gap.engine.priors import ONE_CHANNEL_HZ
from avtorch.gap.engine.recorder import base_fit
from avtorch.gap.quantity import Quantity
from avtorch.gap.result.comparison import Change, ChangeCause, Comparison, SimulatorChange, cause_of_change
from avtorch.gap.result.counted_rows import HORIZON_S, CountedRows, runs_over
from avtorch.gap.result.diagnosis import BlackBoxSimulator
from avtorch.gap.result.log_facts import LogFacts
from avtorch.gap.simulator.effect import Effect, chosen_effects
from avtorch.gap.simulator.plant import GapPlant, plant
from avtorch.io import Log, LogSource, as_logs
from avtorch.io.mapping import Pairs

Simulator = GapPlant | str | PathLike[str] | None

LEVEL = 0.04
"""Significance level: with one car, "no change" is the right answer in more than 95 % of comparisons."""
_CAR = ("T_L", "K_L")
_FEWEST = 5  # blocks on either side, and runs
_SHORTEST_S = 4.0  # of a block
_DRAWS = 2000
_HORIZONS = (HORIZON_S, 5.0, 2.0, 1.0)


@shows_progress
def compare(
    before: LogSource | Sequence[LogSource],
    after: LogSource | Sequence[LogSource],
    *,
    map: Pairs = None,
    unit: Pairs = None,
    baseline: Simulator | BlackBoxSimulator = None,
    baseline_after: Simulator = None,
    level: float = LEVEL,
    effects: Sequence[str | type[Effect]] | None = None,
    progress: Callable[[str, int, int], None] | bool | None = None,
) -> Comparison:
    """What changed from the drives `before` to those `after`.

    `before`, `after`: each a `Log`, a path or a data frame, or several; `map`, `unit`: names and units of the columns
    of those that are read here, as `Log.read` takes them.

    `baseline`: the simulator with which both are compared (`baseline_after`: another one for the second set), with its
    own `T_L` and `K_L`; default: bare GLVD fitted to the drives before. Its effects keep their values in the fits of
    the car. One that is not made of effects comes as an `avtorch.ExternalSimulator`, for all drives (two such:
    `avtorch.compare_simulators`). `level`: significance level of a difference between the drives. `effects`:
    candidates, by name or class, for the cause of a change, beside T_L, K_L and dead time (default: all registered;
    none: `[]`).
    `progress(what, done, of)` is called at every hypothesis; or True, False, None, as in `diagnose`.

    Raises `InputError` for logs that cannot be diagnosed or hold less than five blocks of 4 s of usable driving,
    channels that differ, an unknown effect, or a level out of range.

    Example:
        >>> from avtorch import GLVDPlant, Leader, compare, simulate
        >>> leader = Leader.default(start=50.0, duration=54.0, dt=0.1)
        >>> before, after = (simulate(leader, plant=GLVDPlant(*car)).log() for car in ((0.3, 1.0), (0.3, 0.7)))
        >>> found = compare(before, after, effects=["sensor_bias"])  # leave effects out to try all
        >>> found.changed, round(found.car["K_L"].after.mean, 1), found.simulator
        (True, 0.7, 'farther')
        >>> found.cause.names
        ('K_L',)
    """
    told = called(progress)
    if not 0 < level < 1:
        raise InputError(f"level: found {level}, needs a number between 0 and 1")
    sides = [as_logs(x, map=map, unit=unit, argument=name) for x, name in ((before, "before"), (after, "after"))]
    kinds = chosen_effects(effects)
    if isinstance(baseline, BlackBoxSimulator):
        if baseline_after is not None:
            raise InputError("baseline_after: found beside a simulator that is no plant, needs compare_simulators")
        beside = baseline.beside([*sides[0], *sides[1]], told)
        sides = [list(beside.logs[: len(sides[0])]), list(beside.logs[len(sides[0]) :])]
        baseline = beside.plant
    given = [baseline, baseline if baseline_after is None else baseline_after]
    plants = [b if isinstance(b, GapPlant) else plant([], baseline=b) for b in given]
    if told is not None:
        told("lag and gain of both drives", 0, 2)
    fitted = [_LagAndGain.of(logs, plants[0], name) for logs, name in zip(sides, ("before", "after"), strict=True)]
    one, two = fitted
    if one.rows.channels != two.rows.channels:
        raise InputError("before, after: have different channels; needs accel, speed or both in both")
    away = two.mean - one.mean
    covariance = one.covariance + two.covariance
    blocks = min(one.blocks, two.blocks)
    # Hotelling's test: two parameters, spreads estimated from this many blocks
    square = float(away @ np.linalg.solve(covariance, away))
    count = len(_CAR)
    statistic = square * (blocks - count) / (count * (blocks - 1))
    p_value = float(fisher.sf(statistic, count, blocks - count))  # pyright: ignore[reportUnknownMemberType]
    sure = float(student.ppf(0.95, blocks - 1))  # pyright: ignore[reportUnknownMemberType]
    car = {
        name: Change(
            Quantity.of_logarithm(one.mean[i], one.covariance[i, i], sure),
            Quantity.of_logarithm(two.mean[i], two.covariance[i, i], sure),
            Quantity.of_logarithm(away[i], covariance[i, i], sure),
        )
        for i, name in enumerate(_CAR)
    }
    simulators = [p if b is not None else one.fitted(plants[0]) for p, b in zip(plants, given, strict=True)]
    facts = [LogFacts.of(logs) for logs in sides]
    same = replace(facts[0], name="") == replace(facts[1], name="")
    horizon, runs = whole_runs([side.rows for side in fitted])
    gap = _gaps(fitted, simulators, horizon, runs, same=same)
    simulator = _simulator_change(gap)
    changed = p_value < level
    cause = None
    if told is not None:
        told("one model of both drives", 1, 2)
    try:
        model = None if same else JointModel.of(DriveData.of([*sides[0], *sides[1]]), len(sides[0]), plants[0])
    except InputError:  # other rates, or kinds of accelerometer
        model = None
    if model is not None:
        cause = cause_of_change(model, kinds, progress=told)
    return Comparison(
        before=facts[0],
        after=facts[1],
        car=car,
        gap=gap,
        p_value=p_value,
        changed=changed,
        simulator=simulator,
        why=_sentence(car, p_value, simulator, changed, cause, same=same, simulators=1 + (given[0] is not given[1])),
        cause=cause,
        horizon_s=horizon,
    )


@dataclass(frozen=True, eq=False)
class _LagAndGain:
    """One set of drives, `rows`: `mean` and `covariance` of ln T_L and ln K_L, behind a recorder, by `blocks`."""

    rows: CountedRows = field(repr=False)
    mean: FloatArray
    covariance: FloatArray = field(repr=False)
    blocks: int

    @classmethod
    def of(cls, logs: Sequence[Log], base: GapPlant, which: str) -> _LagAndGain:
        data = DriveData.of(logs)
        rows = CountedRows.of(logs, data)
        check_length(rows, which)
        alone = data.channel_count == 1
        h = base_fit(data.below(ONE_CHANNEL_HZ) if alone else data, base, alone=alone)
        names = h.free
        J = jacobian(h, names)
        here = np.array([h[name] for name in _CAR])
        slopes = np.array([*here, *np.ones(len(names) - 2)])  # of the parameters by the logarithms of the first two
        W = whitened_jacobian(h, J) * slopes[:, None]
        information = W @ W.T + np.diag(prior_terms(h, names)[0] * slopes**2)
        scores = block_scores(h, h.covariance, J, h.residual) * slopes[:, None]  # (parameter, block)
        scores -= scores.mean(1, keepdims=True)
        count = scores.shape[1]
        between = scores @ scores.T * count / (count - 1)
        inverse = np.linalg.inv(information)
        root = np.linalg.cholesky(0.5 * (inverse + inverse.T))
        # in coordinates that whiten the posterior: the spread is no smaller than the posterior's in any direction
        sizes, axes = np.linalg.eigh(root.T @ between @ root)
        spread = root @ axes @ np.diag(np.maximum(sizes, 1.0)) @ axes.T @ root.T
        return cls(rows, np.log(here), spread[:2, :2], count)

    def fitted(self, base: GapPlant) -> GapPlant:
        """The simulator with this lag and gain."""
        return base.with_values(dict(zip(_CAR, np.exp(self.mean).tolist(), strict=True)))


def check_length(rows: CountedRows, which: str) -> None:
    """Raises `InputError` for less than five blocks of 4 s."""
    blocks = int(rows.rows * rows.dt / _SHORTEST_S)
    if blocks < _FEWEST:
        raise InputError(f"{which}: found {blocks} blocks of 4 s of usable driving, needs {_FEWEST} or more")


def whole_runs(sides: Sequence[CountedRows]) -> tuple[float, list[list[slice]]]:
    """Length of the free runs [s], up to `HORIZON_S`, and the whole runs of each side: errors grow with the length, so
    it is the longest of which all sides hold enough."""
    horizon, each = _HORIZONS[-1], []
    for horizon in _HORIZONS:
        rows = [round(horizon / side.dt) for side in sides]
        cut = [runs_over(side.stretches, n) for side, n in zip(sides, rows, strict=True)]
        each = [[run for run in runs if run.stop - run.start == n] for runs, n in zip(cut, rows, strict=True)]
        if min(map(len, each)) >= _FEWEST:
            break
    return horizon, each


def _gaps(
    sides: Sequence[_LagAndGain],
    simulators: Sequence[GapPlant],
    horizon: float,
    runs: Sequence[Sequence[slice]],
    *,
    same: bool,
) -> dict[str, Change]:
    """Errors of free runs before and after, by metric; the `same` drives have the same bootstrap draws."""
    drawn: list[dict[str, FloatArray]] = []
    for i, (side, simulator, own) in enumerate(zip(sides, simulators, runs, strict=True)):
        record, count = side.rows, len(own)
        squares = record.squares(record.measured - record.rolled_out(simulator), own, horizon)
        weights = np.random.default_rng(0 if same else i).multinomial(count, np.full(count, 1 / count), size=_DRAWS)
        weights = np.concatenate([np.ones((1, count)), weights])
        rows = (own[0].stop - own[0].start) * record.group
        drawn.append({name: np.sqrt(weights @ x / (count * rows)) for name, x in squares.items()})
    return {
        name: Change(*(Quantity.of_resampled(x[0], x[1:]) for x in (before, drawn[1][name], drawn[1][name] / before)))
        for name, before in drawn[0].items()
    }


def _simulator_change(gap: Mapping[str, Change]) -> SimulatorChange:
    ratios = [moved.ratio for moved in gap.values()]
    closer, farther = any(r.q95 < 1 for r in ratios), any(r.q05 > 1 for r in ratios)
    return "inconclusive" if closer == farther else "closer" if closer else "farther"


def _sentence(
    car: Mapping[str, Change],
    p_value: float,
    simulator: SimulatorChange,
    changed: bool,
    cause: ChangeCause | None,
    *,
    same: bool,
    simulators: int,
) -> str:
    if same and simulators == 1:
        return "Both sides are the same drive and the same simulator: there is nothing to compare."
    if same:
        two = {"closer": "The second simulator is closer", "farther": "The second simulator is farther from it"}
        return f"One drive, two simulators. {two.get(simulator, 'Neither simulator is measurably closer to it')}."
    numbers = ", ".join(
        f"{name} {car[name].before.mean:.2f} to {car[name].after.mean:.2f}{unit}"
        for name, unit in (("T_L", " s"), ("K_L", ""))
    )
    first = "The car has changed: as GLVD without any effect," if changed else "T_L and K_L alone show no change:"
    words = {
        "closer": "the drives after are closer to the simulator",
        "farther": "the drives after are farther from the simulator",
        "inconclusive": "the simulator's error has not changed measurably",
    }
    last = "The drives are too unlike to name a cause." if cause is None else cause.why
    return f"{first} {numbers} (p = {p_value:.2g}); {words[simulator]}. {last}"
