"""Which of two simulators is nearer to a car: both driven by the commands of its drives, scored by one measure.

Both are scored on the same rows, by the errors of free runs of 10 s as `avtorch.compare` has them. Nothing is fitted
to the car: the surrogates are fitted to the simulators' own output. So nothing has to be held out.

Let `s_b` and `t_b` be the shares of block `b` in the squared errors S and T of the two. The logarithm of the ratio of
the root mean squares, log(T / S) / 2, moves by `(t_b - s_b) / 2` with the weight of block `b`. Over n blocks it thus
has the variance

    n / (n - 1) Σ_b ((t_b - s_b) / 2)²

(the linearised jackknife), and Student's t of n - 1 degrees. Channels count alike: their logarithms are averaged.

By what one is nearer: let S be the farther simulator, M its surrogate, and M' the same chain with some parts (lag,
gain, effects) as in the other's surrogate. Then S + M' - M is S with those parts as in the other one, as far as the
surrogates are what the simulators are. Parts compensate each other (a gain and a drag, a lag and a dead time), so what
one is worth depends on which others have been put in before. Each gets its mean over all orders (Shapley 1953) of what
it does to the logarithm of the error. So the factors of all differences multiply to that of all of them together.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from math import factorial
from os import PathLike, fspath
from typing import Any, Literal

import numpy as np
from scipy.stats import t as student  # pyright: ignore[reportMissingTypeStubs]

from avtorch.arrays import FloatArray
from avtorch.display import Card, Displayed, Frame
from avtorch.display.progress import called, shows_progress
from avtorch.errors import InputError
from avtorch.external.external_simulator import ExternalSimulator, Progress
from avtorch.external.simulator import DrivenPlant
from avtorch.external.surrogate import Surrogate, surrogate_of
from avtorch.gap.compare import LEVEL, check_length, whole_runs
from avtorch.gap.quantity import Quantity, of_fields, unit_behind, words_of
from avtorch.gap.result.counted_rows import CountedRows
from avtorch.gap.result.log_facts import LogFacts
from avtorch.gap.simulator.effect import Effect
from avtorch.gap.simulator.plant import GapPlant, plant
from avtorch.io import Log, LogSource, as_logs
from avtorch.io.mapping import Pairs

Which = Literal["first", "second"]
MATERIAL = 0.01
"""Share of its error by which a simulator has to be better before it is nearer."""
OTHERS = "others"
"""Name of the differences that are told together."""
_CHANNEL = {"rollout_rmse_accel": "acceleration", "rollout_rmse_speed": "speed"}


@dataclass(frozen=True)
class ComparedSimulator:
    """One of the two: `name`; `source`: "plant", "output" or "simulator"; `surrogate`: the chain of effects that
    answers as it does (a plant's is itself); `offset_s`: what its clock was ahead of the log's, by drive; `notes`."""

    name: str
    source: str
    surrogate: Surrogate
    offset_s: tuple[float, ...]
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class ErrorsOfTwo:
    """Rollout errors of both, and the second's relative to the first's, each with its central 90 %."""

    first: Quantity
    second: Quantity
    ratio: Quantity


@dataclass(frozen=True)
class Difference:
    """What the two have differently: `name` is `T_L`, `K_L` or an effect, its parameters in the `first` and in the
    `second` (None: it has no such effect); or `others`, where several, `parts`, are told together. `ratio`: the factor
    by which it changes the error of the farther one, there as in the nearer one; the mean over all orders in which the
    differences can be put in."""

    name: str
    first: Mapping[str, float] | None
    second: Mapping[str, float] | None
    ratio: Quantity
    parts: tuple[str, ...]

    @property
    def brings_nearer(self) -> bool:
        """Whether the error surely falls, at 95 %."""
        return self.ratio.q95 < 1

    def __str__(self) -> str:
        if self.name == OTHERS:
            return f"{', '.join(self.parts)} together"
        if self.first is None or self.second is None:
            only, own = ("second", self.second) if self.first is None else ("first", self.first)
            return f"{self.name} ({_told_values(own or {})}), which only the {only} has"
        return f"{self.name} ({_told_values(self.first)} in the first, {_told_values(self.second)} in the second)"


@dataclass(frozen=True, repr=False)
class SimulatorComparison(Displayed):
    """`errors` by metric: root mean squares over rollouts of `horizon_s` [s]. `ratio`: the second's error relative to
    the first's, the geometric mean over the metrics. `p_first`, `p_second`: probability that it is nearer, by 1 % of
    its error at least, from the spread between `blocks` blocks of the drives. `differences`: what matters most first.
    """

    log: LogFacts
    first: ComparedSimulator
    second: ComparedSimulator
    errors: Mapping[str, ErrorsOfTwo]
    ratio: Quantity
    p_first: float
    p_second: float
    level: float
    blocks: int
    horizon_s: float
    differences: tuple[Difference, ...]

    def overview(self) -> Card:
        """Which one is nearer, and the errors of both."""
        rows = [
            {"error": metric, "first": e.first.mean, "second": e.second.mean, "ratio": e.ratio.mean}
            for metric, e in self.errors.items()
        ]
        return Card("Comparison of two simulators", (self.why,), Frame.of_rows(rows))

    @property
    def nearer(self) -> Which | None:
        """The nearer one; None where these drives cannot tell them apart at `level`, half of it on either side."""
        sure = 1 - self.level / 2
        return "first" if self.p_first > sure else "second" if self.p_second > sure else None

    @property
    def why(self) -> str:
        """The answer in a sentence or two."""
        errors = ", ".join(
            f"{_CHANNEL[metric]} error {e.first.mean:.3g} and {e.second.mean:.3g}" for metric, e in self.errors.items()
        )
        names = f"first: {self.first.name}, second: {self.second.name}"
        if self.nearer is None:
            r = self.ratio
            return (
                f"These drives cannot tell which simulator is nearer ({names}): the second's error is {r.mean:.2f} "
                f"({r.q05:.2f} to {r.q95:.2f}) of the first's; {errors}.{self._by_channel()}"
            )
        sure = max(self.p_first, self.p_second)
        told = f"at a probability of {sure:.3f}" if sure < 0.9995 else "at a probability above 0.999"
        said = f"The {self.nearer} simulator is nearer to the car, {told} ({names}): {errors}."
        chief = [f"{d}, a factor of {d.ratio.mean:.2f}" for d in self.differences if d.brings_nearer][:2]
        if not chief:
            return f"{said} No single one of their differences surely makes it so."
        return f"{said} What brings it nearer: {'; '.join(chief)} in its error."

    def _by_channel(self) -> str:
        """A sentence where the channels contradict each other."""
        first = [_CHANNEL[m] for m, e in self.errors.items() if e.ratio.q05 > 1]
        second = [_CHANNEL[m] for m, e in self.errors.items() if e.ratio.q95 < 1]
        if not (first and second):
            return ""
        return f" The first is nearer in {' and '.join(first)}, the second in {' and '.join(second)}."

    def to_dict(self) -> dict[str, Any]:
        """The object of `comparison.json` for two simulators, schema `avtorch.simulators/1`."""
        out = of_fields(self)
        probability = {"first": out.pop("p_first"), "second": out.pop("p_second")}
        answer = {"probability": probability, "nearer": self.nearer, "why": self.why}
        return {"schema": "avtorch.simulators/1", **out, **answer}


def _told_values(values: Mapping[str, float]) -> str:
    told = []
    for key, value in values.items():
        words = "" if key in ("T_L", "K_L") else f"{words_of(key)} "
        told.append(f"{words}{value:.3g}{unit_behind(key)}")
    return ", ".join(told)


_LEAST = 1e-9  # m/s² or m/s: an error, so that simulators without any have a ratio


def ratio_of(log_ratio: FloatArray) -> Quantity:
    """A ratio by its logarithm and what each block adds to that, (1 + block,), these in the sum zero."""
    sure = float(student.ppf(0.95, len(log_ratio) - 2))  # pyright: ignore[reportUnknownMemberType]
    return Quantity.of_logarithm(float(log_ratio[0]), _sd(log_ratio) ** 2, sure)


def p_below(log_ratio: FloatArray, limit: float) -> float:
    """Probability that a ratio, as `ratio_of` takes it, is below `limit`."""
    away, sd = float(np.log(limit) - log_ratio[0]), _sd(log_ratio)
    if sd == 0:
        return float(away > 0)
    return float(student.cdf(away / sd, len(log_ratio) - 2))  # pyright: ignore[reportUnknownMemberType]


def _sd(log_ratio: FloatArray) -> float:
    n = len(log_ratio) - 1
    return float(np.sqrt(n / (n - 1) * (log_ratio[1:] ** 2).sum()))


def log_root(squares: FloatArray) -> FloatArray:
    """Logarithm of the root of the sum of squares (block,), and by how much each block moves it: (1 + block,)."""
    return 0.5 * np.append(np.log(squares.sum()), squares / squares.sum())


def log_errors(rows: CountedRows, blocks: Sequence[slice], errors: FloatArray) -> dict[str, FloatArray]:
    """Logarithms of root mean squares by metric, (1 + block,) as `ratio_of` takes them, of a rollout's `errors`
    (channel, counted, group) in free runs over the `blocks`."""
    count = np.array([(b.stop - b.start) * rows.group for b in blocks], dtype=float)
    squares = rows.squares(errors, blocks)
    return {name: log_root(np.maximum(x, _LEAST**2 * count)) - log_root(count) for name, x in squares.items()}


_SAME = 0.01  # relative difference of parameters that is none
_MOST = 6  # differences told one by one; those that do less alone are told together


def differences(
    rows: CountedRows, blocks: Sequence[slice], surrogates: Sequence[Surrogate], far: int, errors: FloatArray
) -> tuple[Difference, ...]:
    """What the `surrogates` of two simulators have differently, that which most brings number `far` nearer first.

    `errors` (channel, counted, group): those of the simulator `far`.
    """
    chains = [surrogate.plant for surrogate in surrogates]
    base, donor = chains[far], chains[1 - far]
    own = rows.rolled_out(base)
    each = [{key: {key: x} for key, x in s.lag_and_gain.items()} | s.sizes() for s in surrogates]
    sides = {name: [values.get(name) for values in each] for name in _parts(chains)}
    apart = [name for name, (one, two) in sides.items() if not _alike(one, two)]
    known: dict[frozenset[str], FloatArray] = {}

    def with_parts(names: frozenset[str]) -> FloatArray:
        """Of the error with these parts as in the other one, the mean over the metrics."""
        if names not in known:
            changed = base
            for name in sorted(names):
                changed = _with_part(changed, donor, name)
            moved = errors + own - rows.rolled_out(changed) if names else errors
            known[names] = np.mean([*log_errors(rows, blocks, moved).values()], 0)
        return known[names]

    as_it_is = with_parts(frozenset())
    alone = sorted(apart, key=lambda name: -abs((with_parts(frozenset((name,))) - as_it_is)[0]))
    groups = {name: frozenset((name,)) for name in alone[:_MOST]}
    if alone[_MOST:]:
        groups[OTHERS] = frozenset(alone[_MOST:])
    found = []
    for name, own_parts in groups.items():
        others = [group for other, group in groups.items() if other != name]
        log_ratio = np.zeros(1 + len(blocks))
        for count in range(len(others) + 1):
            weight = factorial(count) * factorial(len(others) - count) / factorial(len(others) + 1)
            for chosen in combinations(others, count):
                there = frozenset().union(*chosen)
                log_ratio += weight * (with_parts(there | own_parts) - with_parts(there))
        one, two = sides.get(name, (None, None))
        found.append(Difference(name, one, two, ratio_of(log_ratio), tuple(sorted(own_parts))))
    return tuple(sorted(found, key=lambda difference: difference.ratio.mean))


def _parts(chains: Sequence[GapPlant]) -> list[str]:
    """`T_L`, `K_L` and the effects of either. An effect that shares the actuator's lag takes `T_L` with it."""
    effects = {e.name: e for chain in chains for e in chain.effects}
    lag = [] if any(_shares_lag(e) for e in effects.values()) else ["T_L"]
    return [*lag, "K_L", *effects]


def _shares_lag(effect: Effect) -> bool:
    return "tau" in effect.actuator_parameters()


def _with_part(base: GapPlant, donor: GapPlant, name: str) -> GapPlant:
    """`base` with one part as in `donor`."""
    if name in ("T_L", "K_L"):
        return base.with_values({name: getattr(donor, name)})
    given = [e for e in donor.effects if e.name == name]
    kept = [e for e in base.effects if e.name != name]
    lag = donor if any(_shares_lag(e) for e in (*donor.effects, *base.effects) if e.name == name) else base
    return GapPlant([*kept, *given], T_L=lag.T_L, K_L=base.K_L, sigma=base.sigma)


def _alike(one: dict[str, float] | None, two: dict[str, float] | None) -> bool:
    if one is None or two is None or one.keys() != two.keys():
        return False
    return all(np.isclose(one[key], two[key], rtol=_SAME, atol=0.0) for key in one)


_CHANNELS = ("accel", "speed")


@shows_progress
def compare_simulators(
    logs: LogSource | Sequence[LogSource],
    first: ExternalSimulator | GapPlant | str | PathLike[str],
    second: ExternalSimulator | GapPlant | str | PathLike[str],
    *,
    map: Pairs = None,
    unit: Pairs = None,
    level: float = LEVEL,
    progress: Progress | bool | None = None,
) -> SimulatorComparison:
    """Which of two simulators is nearer to the car that drove `logs`, and by what.

    `logs`: one log or several, each a `Log`, a path or a data frame; `map`, `unit`: as `Log.read` takes them, for what
    is read here. `first`, `second`: each a simulator that is not avtorch's own (`ExternalSimulator`: its output, an
    object with `reset` and `step`, an FMU), a plant, or one as text (`"dead_time=0.2, T_L=0.4"`) or TOML. `level`: how
    often two that are equally near may be told apart. `progress(what, done, of)` is called at each step; or
    True, False, None, as in `avtorch.diagnose`.

    Raises `InputError` for a level out of range, logs with less than five blocks of 4 s of usable driving, simulators
    without a channel of the logs, and as `ExternalSimulator.beside`.

    Example:
        >>> import numpy as np
        >>> from avtorch import ExternalSimulator, Leader, compare_simulators, simulate
        >>> from avtorch.gap import plant
        >>> class Mine:
        ...     def reset(self, *, speed, accel):
        ...         self.speed, self.accel = speed, accel
        ...     def step(self, accel_cmd, dt):
        ...         before = self.accel
        ...         self.accel = accel_cmd + np.exp(-dt / 0.3) * (before - accel_cmd)
        ...         self.speed += dt * (before + self.accel) / 2
        ...         return self.accel, self.speed
        >>> car = plant(baseline="dead_time=0.3", T_L=0.3, sigma=0.02)
        >>> log = simulate(Leader.default(start=30.0, duration=60.0, dt=0.05), plant=car).log()
        >>> told = compare_simulators(log, ExternalSimulator(Mine), "dead_time=0.3, T_L=0.3")
        >>> told.nearer, [d.name for d in told.differences if d.brings_nearer]
        ('second', ['dead_time'])
    """
    if not 0 < level < 1:
        raise InputError(f"level: found {level}, needs a number between 0 and 1")
    each, steps = as_logs(logs, map=map, unit=unit), called(progress)
    given = [_driven(x) for x in (first, second)]
    rolled = [simulator.outputs(each, steps) for simulator, _ in given]
    outputs = [own for own, _ in rolled]
    cars = _scored(each, outputs)
    surrogates = [
        surrogate_of(own, progress=steps) if chain is None else Surrogate(chain, {})
        for (_, chain), own in zip(given, outputs, strict=True)
    ]
    rows = CountedRows.of(cars)
    check_length(rows, "logs")
    horizon, (blocks,) = whole_runs([rows])
    errors = [rows.measured - rows.of_logs(own) for own in outputs]
    one, two = (log_errors(rows, blocks, e) for e in errors)
    both = np.mean([two[metric] - one[metric] for metric in one], 0)
    far = 0 if both[0] < 0 else 1
    told = []
    for (simulator, chain), (_, offsets), surrogate in zip(given, rolled, surrogates, strict=True):
        source = "plant" if chain is not None else "simulator" if simulator.output is None else "output"
        notes = tuple(getattr(simulator.of, "notes", ()))
        told.append(ComparedSimulator(simulator.name, source, surrogate, offsets, notes))
    return SimulatorComparison(
        log=LogFacts.of(each),
        first=told[0],
        second=told[1],
        errors={
            metric: ErrorsOfTwo(ratio_of(one[metric]), ratio_of(two[metric]), ratio_of(two[metric] - one[metric]))
            for metric in one
        },
        ratio=ratio_of(both),
        p_first=1 - p_below(both, 1 / (1 - MATERIAL)),
        p_second=p_below(both, 1 - MATERIAL),
        level=level,
        blocks=len(blocks),
        horizon_s=horizon,
        differences=differences(rows, blocks, surrogates, far, errors[far]),
    )


def _driven(
    given: ExternalSimulator | GapPlant | str | PathLike[str],
) -> tuple[ExternalSimulator, GapPlant | None]:
    """A simulator that can be driven, and the plant that it is, if it is one, without what chance decides."""
    if isinstance(given, ExternalSimulator):
        return given, None
    own = plant(baseline=given)
    own = GapPlant([e for e in own.effects if not e.random], T_L=own.T_L, K_L=own.K_L, sigma=0.0)
    name = "plant" if isinstance(given, GapPlant) else fspath(given)
    return ExternalSimulator(DrivenPlant(own), name=name), own


def _scored(logs: Sequence[Log], rolled: Sequence[Sequence[Log]]) -> list[Log]:
    """The car's drives with the rows and channels that both simulators have, for which `rolled` holds their outputs."""
    shared = [
        name
        for name in _CHANNELS
        if all(getattr(log, name) is not None for log in (*logs, *(x for outputs in rolled for x in outputs)))
    ]
    if not shared:
        raise InputError("logs: have no channel that both simulators have, needs accel or speed in all three")
    absent: dict[str, None] = {name: None for name in _CHANNELS if name not in shared}
    return [
        replace(log, engaged=log.engaged & one.engaged & two.engaged, **absent)
        for log, one, two in zip(logs, *rolled, strict=True)
    ]
