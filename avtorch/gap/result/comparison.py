"""The result of comparing two sets of drives."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any, Literal

from avtorch.display import Card, Displayed, Frame
from avtorch.gap.answer.change import ChangeCause
from avtorch.gap.quantity import Quantity, unit_of
from avtorch.gap.result.diagnosis import LogFacts

if TYPE_CHECKING:
    import pandas

SimulatorChange = Literal["closer", "farther", "inconclusive"]
Explanation = Literal["lag and gain", "not lag and gain", "not distinguishable"]

_SURE = 0.75  # three to one: the probability from which on an explanation stands


@dataclass(frozen=True)
class Change:
    """One number before and after, and the ratio of after to before, each with its central 90 %."""

    before: Quantity
    after: Quantity
    ratio: Quantity

    def to_dict(self) -> dict[str, Any]:
        return asdict(self)


@dataclass(frozen=True)
class DeadTimeTest:
    """Whether lag and gain explain a change better than a change of dead time, by one model of both sets of drives.

    Dead time [s] `before`, `after` and their `difference`, where lag and gain may have changed as well. `p_lag_gain`:
    probability that lag or gain has changed and the dead time has not; `p_dead_time`: that the dead time alone has;
    the rest: both have.
    """

    before: Quantity
    after: Quantity
    difference: Quantity
    p_lag_gain: float
    p_dead_time: float

    @property
    def explanation(self) -> Explanation:
        """`"lag and gain"` where they alone have changed with a probability of 0.75, `"not lag and gain"` where they
        have not, `"not distinguishable"` otherwise."""
        if self.p_lag_gain < 1 - _SURE:
            return "not lag and gain"
        return "lag and gain" if self.p_lag_gain > _SURE else "not distinguishable"

    def to_dict(self) -> dict[str, Any]:
        delays = {"before": self.before, "after": self.after, "difference": self.difference}
        return {
            "explanation": self.explanation,
            "p_lag_gain": self.p_lag_gain,
            "p_dead_time": self.p_dead_time,
            "dead_time_s": {name: q.to_dict() for name, q in delays.items()},
        }


@dataclass(frozen=True, repr=False)
class Comparison(Displayed):
    """`car`: `T_L` [s] and `K_L` fitted to each set of drives; `gap`: rollout errors of the simulator, by metric, over
    `horizon_s` [s]: 10 s, or less where the longest stretch of either set is shorter.

    `changed`: the car's parameters differ, with p-value `p_value` for drives of one car. `simulator`: whether the
    simulator's errors on the drives after are smaller than those on the drives before (each with its own simulator,
    where two are given); `"inconclusive"`: neither. `dead_time_test`: where the car has changed, whether lag and gain
    explain it; else None. `cause`: what of T_L, K_L, dead time and all effects differs; None where both sides are one
    drive, or too short for it.
    """

    before: LogFacts
    after: LogFacts
    car: Mapping[str, Change]
    gap: Mapping[str, Change]
    p_value: float
    changed: bool
    simulator: SimulatorChange
    why: str
    dead_time_test: DeadTimeTest | None = None
    cause: ChangeCause | None = None
    horizon_s: float = 10.0

    def overview(self) -> Card:
        """What has changed, in a sentence or two, and what was measured before and after."""
        answer = "the car has changed" if self.changed else "no change of T_L and K_L is detected"
        table = {name: values for name, values in self.summary().columns.items() if name != "sd"}
        return Card(
            f"Comparison of two sets of drives: {answer} (p = {self.p_value:.2g})", (self.why,), Frame(table), 9
        )

    def summary(self) -> Frame:
        """A row a parameter or error and `side`: before, after, and their ratio; mean, sd, 5 and 95 % quantiles."""
        rows: list[dict[str, object]] = []
        for name, moved in (*self.car.items(), *self.gap.items()):
            unit = {"rollout_rmse_accel": "m/s²", "rollout_rmse_speed": "m/s"}.get(name) or unit_of(name)
            for side, q in (("before", moved.before), ("after", moved.after), ("ratio", moved.ratio)):
                rows.append({"parameter": name, "side": side, "unit": "-" if side == "ratio" else unit, **q.to_dict()})
        return Frame.of_rows(rows)

    def to_dataframe(self) -> pandas.DataFrame:
        """`summary` as a data frame. Needs ``pip install 'avtorch[pandas]'``."""
        return self.summary().to_dataframe()

    def to_dict(self) -> dict[str, Any]:
        """The object of `comparison.json`, schema `avtorch.comparison/1`."""
        return {
            "schema": "avtorch.comparison/1",
            "before": self.before.to_dict(),
            "after": self.after.to_dict(),
            "car": {name: moved.to_dict() for name, moved in self.car.items()},
            "gap": {name: moved.to_dict() for name, moved in self.gap.items()},
            "horizon_s": self.horizon_s,
            "p_value": self.p_value,
            "changed": self.changed,
            "explained": None if self.dead_time_test is None else self.dead_time_test.to_dict(),
            "cause": None if self.cause is None else self.cause.to_dict(),
            "simulator": self.simulator,
            "why": self.why,
        }
