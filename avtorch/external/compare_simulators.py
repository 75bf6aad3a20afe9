"""Which of two simulators is nearer to a car: both driven by the commands of its drives, scored by one measure.

Both are scored on the same rows, by the errors of rollouts over 10 s as `avtorch.compare` has them. Nothing is fitted
to the car: the surrogates are fitted to the simulators' own output. So nothing has to be held out.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from os import PathLike, fspath

import numpy as np
import torch

from avtorch.arrays import FloatArray
from avtorch.display.progress import called, shows_progress
from avtorch.errors import InputError
from avtorch.external.by_what import differences
from avtorch.external.driven_plant import DrivenPlant
from avtorch.external.external_simulator import ExternalSimulator
from avtorch.external.scored_blocks import ScoredBlocks
from avtorch.external.simulator_comparison import MATERIAL, ComparedSimulator, ErrorsOfTwo, SimulatorComparison
from avtorch.external.surrogate import Surrogate, surrogate_of
from avtorch.gap.compare import LEVEL
from avtorch.gap.drive_record import Record
from avtorch.gap.result.diagnosis import LogFacts
from avtorch.gap.simulator.plant import GapPlant, plant
from avtorch.io import Log, LogSource, as_logs
from avtorch.io.mapping import Pairs

Progress = Callable[[str, int, int], None]
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
    each = as_logs(logs, map=map, unit=unit)
    given = [_driven(x) for x in (first, second)]
    steps = called(progress)
    rolled = [simulator.outputs(each, steps) for simulator, _ in given]
    cars = _scored(each, [outputs for outputs, _ in rolled])
    surrogates = [
        surrogate_of(outputs, progress=steps) if own is None else Surrogate(own, {})
        for (_, own), (outputs, _) in zip(given, rolled, strict=True)
    ]
    scored = ScoredBlocks.of(Record.of(cars))
    errors = [_errors(scored.record, outputs) for outputs, _ in rolled]
    lags = [float(surrogate.plant.T_L) for surrogate in surrogates]
    one, two = (scored.squares(e, lag) for e, lag in zip(errors, lags, strict=True))
    both = scored.log_ratio(one, two)
    far = 0 if both.mean < 0 else 1
    chains = [surrogate.plant for surrogate in surrogates]
    told = [
        _told(simulator, surrogate, offsets, is_plant=own is not None)
        for (simulator, own), surrogate, (_, offsets) in zip(given, surrogates, rolled, strict=True)
    ]
    return SimulatorComparison(
        log=LogFacts.of(each),
        first=told[0],
        second=told[1],
        errors={
            metric: ErrorsOfTwo(
                scored.error(one[metric]),
                scored.error(two[metric]),
                scored.log_ratio({metric: one[metric]}, {metric: two[metric]}).ratio,
            )
            for metric in one
        },
        ratio=both.ratio,
        p_first=1 - both.p_below(1 / (1 - MATERIAL)),
        p_second=both.p_below(1 - MATERIAL),
        level=level,
        blocks=len(scored.blocks),
        horizon_s=scored.horizon_s,
        differences=differences(scored, chains, far, errors[far]),
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


def _errors(record: Record, outputs: Sequence[Log]) -> FloatArray:
    """(channel, counted, group): the car's less the simulator's."""
    simulated = [
        record.at_counted_rows([torch.as_tensor(getattr(outputs[cut.log], name)[cut.rows]) for cut in record.cuts])
        for name in record.channels
    ]
    return record.measured - np.stack(simulated)


def _told(
    simulator: ExternalSimulator, surrogate: Surrogate, offsets: tuple[float, ...], *, is_plant: bool
) -> ComparedSimulator:
    source = "plant" if is_plant else "simulator" if simulator.output is None else "output"
    return ComparedSimulator(simulator.name, source, surrogate, offsets, tuple(getattr(simulator.of, "notes", ())))
