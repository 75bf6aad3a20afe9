"""What is known of the recorded cars by other means, beside what a budget says of it.

None of it serves the diagnosis. An accelerometer's offset is the mean of its reading less dv/dt while the car is faster
than 0.5 m/s, its low-pass the filter of dv/dt that correlates best with it; figures of DART are those of its authors'
model at this drive's mean speed; those of the Genesis and the truck come with the recordings.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from avtorch.gap.quantity import Quantity, unit_of
from avtorch.gap.result.budget import Budget
from benchmarks.blindtest.intervals import counted
from benchmarks.budget_cells import interval

LAG_WITH_DELAY = "T_L with delay_s"


@dataclass(frozen=True)
class Fact:
    """A fact in `words`, and where a budget tells it: a `parameter` of an `effect`, or of the baseline (None).

    `LAG_WITH_DELAY` is the baseline's lag with the dead time that was fitted beside it. `value`: None where only the
    cause is known.
    """

    words: str
    effect: str | None
    parameter: str
    value: float | None


_GENESIS = (
    Fact("lag with delay", None, LAG_WITH_DELAY, 0.32),
    Fact("gain", None, "K_L", 0.96),
)
_DART = (
    Fact("resistance at the mean speed", "constant_resistance", "resistance_mps2", 2.9),
    Fact("slope of the gain", "speed_dependent_gain", "gain_slope", -0.87),
    Fact("gain of the nominal map", None, "K_L", 0.53),
)


def _offset(value: float) -> tuple[Fact, ...]:
    return (Fact("the accelerometer's offset", "sensor_bias", "bias_mps2", value),)


FACTS: Mapping[str, Sequence[Fact]] = {
    "genesis, three laps": _GENESIS,
    "genesis, lap 1": _GENESIS,
    "genesis, lap 2": _GENESIS,
    "genesis, lap 3": _GENESIS,
    "indy_av21": (Fact("the accelerometer's low-pass", "sensor_lag", "lag_s", 2.5),),
    "roboracer, one mass": _offset(-0.228),
    "roboracer, other mass": _offset(-0.235),
    "roboracer, tyres": _offset(-0.174),
    "roboracer, training": _offset(-0.16),
    "dart, 10:27": _DART,
    "dart, 10:27, motion capture": _DART,
    "volvo_truck": (Fact("driven on a grade", "road_grade", "grade_rms", None),),
}
"""By the name of a recording in `benchmarks.recordings.SETS`."""

HEADER = "| recording | fact | known | budget | its 90 % interval |\n|---|---|---|---|---|"


@dataclass(frozen=True)
class Told:
    """A `fact` of a `recording`, and what its budget says: `found`, and the cause's `share` of the gap.

    `found`: None where the cause is not named; `share`: None of the baseline.
    """

    recording: str
    fact: Fact
    found: Quantity | None
    share: float | None

    @property
    def holds(self) -> bool | None:
        """Whether the interval holds the figure; None where there is no figure, or nothing is named to have one."""
        if self.found is None or self.fact.value is None:
            return None
        return self.found.q05 <= self.fact.value <= self.found.q95

    def __str__(self) -> str:
        """Its row of the table under `HEADER`."""
        fact = self.fact
        unit = unit_of(fact.parameter)
        known = "no figure" if fact.value is None else f"{fact.value:g}{'' if unit == '-' else f' {unit}'}"
        name = fact.effect or fact.parameter
        if self.found is None:
            return f"| {self.recording} | {fact.words} | {known} | {name} is not named | |"
        share = "" if self.share is None else f" {self.share:.0%}:"
        said = {True: "holds", False: "does not hold", None: "right cause"}[self.holds]
        return f"| {self.recording} | {fact.words} | {known} | {name}{share} {interval(self.found)} | {said} |"


def told(recording: str, budget: Budget) -> list[Told]:
    """Each fact of this recording beside its budget."""
    return [_told(recording, fact, budget) for fact in FACTS.get(recording, ())]


def _told(recording: str, fact: Fact, budget: Budget) -> Told:
    if fact.effect is None:
        return Told(recording, fact, _of_the_baseline(fact.parameter, budget), None)
    part = next((part for part in budget.parts if part.name == fact.effect and part.name in budget.names), None)
    if part is None:
        return Told(recording, fact, None, None)
    return Told(recording, fact, part.parameters.get(fact.parameter), part.share.mean)


def _of_the_baseline(parameter: str, budget: Budget) -> Quantity | None:
    """Of the baseline that was fitted together with all parts."""
    if parameter != LAG_WITH_DELAY:
        return budget.repaired.get(parameter)
    lag = budget.repaired.get("T_L")
    delay = next((part.parameters["delay_s"] for part in budget.parts if part.name == "dead_time"), None)
    if lag is None or delay is None:
        return lag
    # added at their ends: how the two vary together is not told
    return Quantity(lag.mean + delay.mean, lag.sd + delay.sd, lag.q05 + delay.q05, lag.q95 + delay.q95)


def closing(all_told: Sequence[Told]) -> str:
    """How many intervals hold their figure, of the figures and of those whose cause is named."""
    figures = [one for one in all_told if one.fact.value is not None]
    named = [one for one in figures if one.found is not None]
    holds = sum(bool(one.holds) for one in named)
    of_named = counted(holds, len(named))
    return f"intervals that hold the figure: {counted(holds, len(figures))}, of those with a name {of_named}"
