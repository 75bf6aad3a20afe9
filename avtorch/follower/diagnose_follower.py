"""The diagnosis of a car that follows another, where nobody logged what its controller demanded.

A law is assumed, identified on one half of the drive and tested on the other. The test half, with the commands that the
law would have given, is then diagnosed like any other log: every claim about causes is conditional on the law.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from avtorch.arrays import FloatArray
from avtorch.display import Card, Displayed, Frame
from avtorch.display.progress import called, shows_progress
from avtorch.errors import InputError
from avtorch.follower.identify import Followed, Identified, car_of, followed, identified, seen_in, widened
from avtorch.follower.laws import (
    LAWS,
    FollowerMeasurements,
    HeadwayLaw,
    LoopErrors,
    LoopStability,
    keeps_speed,
    law_named,
    loop_errors,
    loop_stability,
    of_law,
)
from avtorch.gap.diagnose import diagnose
from avtorch.gap.quantity import Quantity, frame_of
from avtorch.gap.result.diagnosis import Diagnosis
from avtorch.gap.simulator.effect import delay_effect, delay_key
from avtorch.io import Log, LogSource, as_log
from avtorch.io.mapping import Pairs

_LEAST_S = 40.0
_LOWEST, _HIGHEST = -8.0, 5.0  # bounds of a command [m/s²]; no car is sent more
_SPOKEN = {"constant_time_gap": "a constant time gap", "intelligent_driver": "the Intelligent Driver Model"}


@dataclass(frozen=True, eq=False, repr=False)
class FollowerDiagnosis(Displayed):
    """The diagnosis of one follower under one `law`.

    - `parameters` of law, lag `T_L` and `delay_s` by name; `lag_with_delay_s`, and at the median speed `headway_s`
    - `loops` by law, `without_delay` (the law chosen, on the bare GLVD) among them: errors of the closed loop over 60
      s, driven by the leader alone, each half with the parameters fitted to the other; `keeps_speed` [m/s]: the error
      of a car that keeps its speed
    - `stability` about slow, usual and quick speeds of the drive
    - `diagnosis`: gap and cause on the test half, conditional on the law; None where it was not requested
    - `conditional`: the condition that each claim rests on, one sentence each
    """

    name: str
    law: HeadwayLaw
    identified: Identified = field(repr=False)
    draws: Mapping[str, FloatArray] = field(repr=False)
    parameters: Mapping[str, Quantity]
    loops: Mapping[str, LoopErrors]
    keeps_speed: float
    stability: tuple[LoopStability, ...]
    diagnosis: Diagnosis | None
    conditional: tuple[str, ...]

    def overview(self) -> Card:
        """The law, string stability at the usual speed, the cause where it was sought, and the parameters."""
        usual = self.usual
        lines = [f"P(string stable) {usual.p_string_stable:.2f} at {usual.speed:.3g} m/s."]
        if self.diagnosis is not None:
            lines.append(self.diagnosis.overview().title)
        return Card(f"Follower {self.name} under the law {self.law.name}", tuple(lines), self.summary(), most=9)

    def summary(self) -> Frame:
        """A row a parameter of law, lag and delay: unit, mean, sd, the 5 and 95 % quantiles."""
        return frame_of(self.parameters)

    @property
    def usual(self) -> LoopStability:
        """At the median speed."""
        return self.stability[len(self.stability) // 2]

    def sentences(self) -> list[str]:
        """Law, headway, lag with delay, string stability, and how well the closed loop does."""
        q, usual = self.parameters, self.usual
        own, bare = self.loops[self.law.name], self.loops["without_delay"]
        peak = "" if usual.peak_gain is None else f", peak gain {_formatted(usual.peak_gain, '')}"
        rivals = [x for name, x in self.loops.items() if name not in (self.law.name, "without_delay")]
        other = f" (the other law: {rivals[0].speed:.2g} m/s)" if rivals else ""
        return [
            f"Assuming {_SPOKEN[self.law.name]}: headway {_formatted(q['headway_s'], ' s')} at {usual.speed:.0f} m/s, "
            f"lag with delay {_formatted(q['lag_with_delay_s'], ' s')}.",
            f"P(string stable) is {usual.p_string_stable:.2f} at {usual.speed:.0f} m/s{peak}. Over a minute the car "
            f"amplified its leader's speed variation {own.amplified:.2f} times; the simulated loop does "
            f"{own.amplified_simulated:.2f} times.",
            f"Driven by the leader alone over a held-out minute, the loop errs by {own.speed:.2g} m/s and "
            f"{own.spacing:.2g} m{other}; without a dead time by {bare.speed:.2g} m/s and {bare.spacing:.2g} m, and a "
            f"car at constant speed by {self.keeps_speed:.2g} m/s.",
        ]

    def to_dict(self) -> dict[str, Any]:
        """The object of `diagnosis.json` with a further key `follower`; only that key where no cause was sought."""
        follower = {
            "law": self.law.name,
            "parameters": {name: q.to_dict() for name, q in self.parameters.items()},
            "stability": [
                {
                    "speed_mps": s.speed,
                    "p_locally_stable": s.p_locally_stable,
                    "p_string_stable": s.p_string_stable,
                    "peak_gain": None if s.peak_gain is None else s.peak_gain.to_dict(),
                }
                for s in self.stability
            ],
            "closed_loop": {name: errors._asdict() for name, errors in self.loops.items()},
            "keeps_speed_rmse": self.keeps_speed,
            "conditional": list(self.conditional),
        }
        return ({} if self.diagnosis is None else self.diagnosis.to_dict()) | {"follower": follower}


@shows_progress
def diagnose_follower(
    log: LogSource,
    *,
    map: Pairs = None,
    unit: Pairs = None,
    law: str | None = None,
    cause: bool = True,
    effects: Sequence[str] | None = None,
    seed: int = 0,
    progress: Callable[[str, int, int], None] | bool | None = None,
) -> FollowerDiagnosis:
    """Time gap, gains, lag with delay, string stability, gap and cause of a car-following `log`.

    `log`: a `Log`, a path or a data frame; `map`, `unit`: as `Log.read` takes them, for what is read here.
    `law`: `constant_time_gap` or `intelligent_driver`; default: the one that predicts held-out data better.
    `cause` False: stop at the loop. `effects`, `progress`: as `avtorch.diagnose` has them.

    Raises `InputError` for a log without speed, spacing or the leader's speed, with less than 40 s of following, or for
    an unknown law.

    Example:
        >>> from avtorch import Leader, LinearController, simulate
        >>> from avtorch.follower import diagnose_follower
        >>> car = LinearController(gains=(0.2, 0.6, 0.0), time_gap=1.5)
        >>> log = simulate(Leader.default(start=50.0, duration=45.0, dt=0.1), car).log()
        >>> found = diagnose_follower(log, law="constant_time_gap", cause=False)
        >>> round(found.parameters["time_gap_s"].mean, 1)
        1.5
    """
    log = as_log(log, map=map, unit=unit, following=True)
    steps = called(progress)
    laws = list(LAWS.values()) if law is None else [law_named(law)]
    plain = followed(log, laws[0])
    if plain.seconds < _LEAST_S:
        raise InputError(
            f"{log.name}: {plain.seconds:.0f} s of following (moving, engaged), needs {_LEAST_S:g} s or more"
        )
    middle = int(plain.data.source[len(plain.data.source) // 2])
    halves = log[:middle], log[middle:]
    tried: dict[str, tuple[LoopErrors, Identified]] = {}
    for i, own in enumerate(laws):
        if steps is not None:
            steps("laws", i, len(laws))
        tried[own.name] = _crossed(followed(log, own), halves)
    best = min(tried, key=lambda name: tried[name][0].speed)
    chosen, first = LAWS[best], tried[best][1]
    bare, _ = _crossed(followed(log, chosen, dead_time=False), halves)
    full = identified(first.candidate.on(log), start=first)
    draws = full.draws(widened(full), seed=seed)
    assert plain.data.speed is not None
    speeds = np.quantile(plain.data.speed, (0.1, 0.5, 0.9))
    keeps = keeps_speed([_longest(plain.on(half)) for half in halves], plain.data.dt)
    return FollowerDiagnosis(
        name=log.name,
        law=chosen,
        identified=full,
        draws=draws,
        parameters=_parameters(chosen, draws, float(speeds[1])),
        loops={name: errors for name, (errors, _) in tried.items()} | {"without_delay": bare},
        keeps_speed=keeps,
        stability=tuple(loop_stability(chosen, draws, speeds.tolist())),
        diagnosis=_cause(first, halves[1], effects, seed, steps) if cause else None,
        conditional=_conditional(chosen, tried[best][0].speed, keeps),
    )


def _crossed(candidate: Followed, halves: tuple[Log, Log]) -> tuple[LoopErrors, Identified]:
    """The closed loop's errors on each half with parameters fitted to the other, and the fit to the first."""
    own = [candidate.on(half) for half in halves]
    found = [identified(half) for half in own]
    each = [
        loop_errors(candidate.law, fit.values, _longest(half), half.data.dt)
        for fit, half in zip(found, reversed(own), strict=True)
    ]
    return LoopErrors(*(float(np.sqrt(np.mean(np.square(pair)))) for pair in zip(*each, strict=True))), found[0]


def _longest(half: Followed) -> FollowerMeasurements:
    """The measurements of the longest stretch of a half, once the car has settled."""
    seen = max(half.seen, key=lambda stretch: len(stretch.speed))
    return FollowerMeasurements(*(x[half.data.warm_rows :] for x in seen))


def _cause(
    first: Identified,
    half: Log,
    effects: Sequence[str] | None,
    seed: int,
    steps: Callable[[str, int, int], None] | None,
) -> Diagnosis:
    """The diagnosis of the test half, with the law's commands, starting from the lag and delay of the other half."""
    sent = first.candidate.law.command(of_law(first.values), seen_in(half)).numpy()
    late = replace(half, accel=None, accel_cmd=np.clip(sent, _LOWEST, _HIGHEST))
    return diagnose(late, baseline=car_of(first.values), effects=effects, seed=seed, progress=steps or False)


def _parameters(law: HeadwayLaw, draws: Mapping[str, FloatArray], speed: float) -> dict[str, Quantity]:
    quantities = {
        k.removeprefix("law.").removeprefix(f"{delay_effect().name}."): Quantity.of_draws(x) for k, x in draws.items()
    }
    total = draws["T_L"] + draws.get(delay_key(), 0.0)
    more = {"lag_with_delay_s": total, "headway_s": law.spacing(of_law(draws), speed) / speed}
    return quantities | {name: Quantity.of_draws(x) for name, x in more.items()}


def _conditional(law: HeadwayLaw, off: float, keeps: float) -> tuple[str, ...]:
    return (
        f"The controller is not known: {law.name} is assumed. With it the leader's motion alone predicts the speed "
        f"over a minute, on each half as fitted to the other, to {off:.2g} m/s; a car at constant speed would err by "
        f"{keeps:.2g} m/s.",
        "K_L is fixed at 1: the log cannot distinguish it from the law's gains, which are those of controller and car "
        "together.",
        "Lag and delay cover the whole path from the recorded motion to the speed, radar and controller included; a "
        "gain on the car's own acceleration is part of T_L.",
        "P(string stable) holds for small motions; it is the whole loop's, controller and car together.",
        "The cause is conditional on the law: where the real controller departs from it, the car takes the cause.",
    )


def _formatted(q: Quantity, unit: str) -> str:
    return f"{q.mean:.2f}{unit} ({q.q05:.2f} to {q.q95:.2f})"
