"""What one channel alone cannot tell apart, so that it comes back as a set and not as a guess.

With the acceleration only, an offset of the sensor and a constant force on the car are the same thing, a filter in the
sensor is a second pole of the actuator, and the sensor's scale is another `K_L`. What depends on the speed cannot be
judged at all; a force among it would pass for an offset or a gust. With the speed only, the sensor leaves no mark.
With both channels nothing here applies.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field

from avtorch.gap.likelihood.observability import is_observable
from avtorch.gap.search.fitted_model import SearchResult
from avtorch.gap.selection.plausibility import implausible
from avtorch.gap.selection.verdict import ALIAS_RATIO, Candidate, candidate_name, near
from avtorch.gap.simulator.effect import EFFECTS, Effect

_OFFSETS = ("sensor_bias", "constant_resistance")
_LAGS = ("sensor_lag", "second_order_actuator")
_SLOW = (*_OFFSETS, "gust")
_PUSH = {"aerodynamic_drag": -1, "low_speed_creep": 1}  # the only way such a force can point
_ANY_ORDER = (
    "gain_change",
    "outliers",
    *_OFFSETS,
)  # beside commands: what two poles in a row treat alike, wherever they are
_DAMPED = 0.85  # a fit is off by 0.1 or so, and two real poles have a damping of 1 or more

Values = Mapping[str, float]


def exact_aliases(name: str, channels: Collection[str], values: Values | None = None) -> set[str]:
    """Candidates that respond to every command as `name` does, as far as the `channels` show; `name` among them.

    `values`: parameters fitted, by the plant's keys; a resistance can only be an offset below 0, and a sensor's lag
    only an actuator that does not overshoot. Without them every alias counts.
    """
    parts = name.split("+")
    same = {name}
    if set(channels) != {"accel"}:
        return same
    for one in parts:
        others = [p for p in parts if p != one]
        for other in _instead(one, others, values):
            if other not in parts:
                same.add(candidate_name([*others, other]))
    return same


def _instead(one: str, others: Sequence[str], values: Values | None) -> Iterable[str]:
    if one in _OFFSETS:
        below = _offset([one], values)
        return _OFFSETS if below is None or below < 0 else ()
    linear = all(p in _ANY_ORDER or (p in EFFECTS and EFFECTS[p].place == "command") for p in others)
    if one in _LAGS and linear:
        damping = 1.0
        if one == "second_order_actuator" and values is not None:
            damping = values["T_L"] / max(2 * values[f"{one}.inverse_frequency_s"], 1e-9)
        return _LAGS if damping >= _DAMPED else ()
    return ()


def _offset(parts: Iterable[str], values: Values | None) -> float | None:
    """The constant part [m/s²] of what `parts` add to the acceleration; None where they say nothing of it."""
    for part in parts:
        if part == "constant_resistance":
            return -1.0 if values is None else -values["constant_resistance.resistance_mps2"]
        if part == "sensor_bias" and values is not None:
            return values["sensor_bias.bias_mps2"]
    return None


def lookalikes(
    name: str, channels: Collection[str], values: Values | None = None, *, specific_force: bool = False
) -> set[str]:
    """Candidates that were not judged, for want of speed, and whose force may be what `name` takes for a slow one.

    One such force in place of all slow parts of `name` (an offset, a gust), where its direction allows it.
    """
    parts = name.split("+")
    slow = [p for p in parts if p in _SLOW]
    if set(channels) != {"accel"} or not slow:
        return set()
    offset = _offset(slow, values)
    others = [p for p in parts if p not in slow]
    forces = [e for e in EFFECTS.values() if e.place == "body" and e.needs_speed]
    return {
        candidate_name([*others, e.name])
        for e in forces
        if not (e.gravity and specific_force) and (offset is None or _PUSH.get(e.name, 0) * offset >= 0)
    }


def note(channels: Collection[str], effects: Iterable[type[Effect]]) -> str | None:
    """One sentence on what the log cannot judge of `effects`; None where that is nothing."""
    names = sorted(e.name for e in effects if not is_observable(e, channels))
    if not names:
        return None
    if "accel" not in channels:
        return (
            f"Without accel in the log these effects cannot be tested, as speed does not show them: {', '.join(names)}."
        )
    told = []
    need = [n for n in names if n != "sensor_scale"]
    if need:
        told.append(
            f"Without speed in the log these effects cannot be tested and appear as others: {', '.join(need)}."
        )  # fmt: skip
    if "sensor_scale" in names:
        told.append("Without speed in the log sensor_scale is equivalent to another K_L and cannot be tested.")
    return " ".join(told)


@dataclass(frozen=True)
class Identifiability:
    """What a search's candidates can be told apart by: the `channels`, and the `values` fitted of each by name.

    `among`: the effects that were candidates; `prior`: the user's weights by name. Both bound what is added.
    """

    channels: tuple[str, ...]
    values: Mapping[str, Values]
    among: tuple[type[Effect], ...]
    prior: Mapping[str, float] = field(default_factory=dict)
    specific_force: bool = False
    complete: bool = True

    @classmethod
    def of(
        cls, race: SearchResult, among: Iterable[type[Effect]], prior: Mapping[str, float] | None = None
    ) -> Identifiability:
        """From a search."""
        values = {f.name: f.values for f in race.found}
        specific = race.record.accel_kind == "specific-force"
        return cls(race.record.channels, values, tuple(among), dict(prior or {}), specific, race.complete)

    def shared(self, chances: Mapping[str, float]) -> dict[str, float]:
        """Probabilities by name in which exact aliases share what they have together, by the prior's weights (equal
        ones unless given). An alias the search did not try gets its share too.
        """
        out = dict(chances)
        done: set[str] = set()
        for name in sorted(chances, key=lambda n: -chances[n]):
            group = sorted(self._group(name) - done)
            done |= {name, *group}
            weights = [self._weight(n) for n in group]
            if len(group) < 2 or not sum(weights) > 0:
                continue
            total = sum(chances.get(n, 0.0) for n in group)
            out |= {n: total * w / sum(weights) for n, w in zip(group, weights, strict=True)}
        return out

    def mirrored(self, candidates: Sequence[Candidate], chances: Mapping[str, float]) -> list[Candidate]:
        """Candidates for names in `chances` that only `shared` put there, with the evidence of their alias."""
        known = {c.name for c in candidates}
        out = []
        for name in sorted(set(chances) - known):
            source = next(c for c in candidates if name in self._group(c.name))
            own = {"moved": source.moved, "implausible": implausible({}, source.moved), "onset_s": source.onset_s}
            out.append(Candidate(name, chances[name], source.log_evidence, **own))
        return out

    def alias_set(self, candidates: Sequence[Candidate]) -> tuple[str, ...]:
        """The candidates `near` the most probable one, and whatever cannot be told from that one.

        Exact aliases, and forces that were not judged (`lookalikes`), have their place there whatever their
        probability.
        """
        names = near(ALIAS_RATIO)(candidates)
        first = max(candidates, key=lambda c: c.probability).name
        like = lookalikes(first, self.channels, self.values.get(first), specific_force=self.specific_force)
        more = [*sorted(self._group(first)), *sorted(n for n in like if self._allowed(n))]
        if not self.complete:
            more.append("unknown")  # any candidate that the budget left untried
        return tuple(dict.fromkeys([*names, *more]))

    @property
    def note(self) -> str | None:
        """What the log cannot judge, in a sentence."""
        return note(self.channels, self.among)

    def _group(self, name: str) -> set[str]:
        """Exact aliases, each of which also reaches the other's fit; `name` among them."""
        group = exact_aliases(name, self.channels, self.values.get(name))
        return {name} | {
            n
            for n in group
            if self._allowed(n) and name in exact_aliases(n, self.channels, self.values.get(n))
        }  # fmt: skip

    def _allowed(self, name: str) -> bool:
        return set(name.split("+")) <= {e.name for e in self.among} and self._weight(name) > 0

    def _weight(self, name: str) -> float:
        weight = 1.0
        for part in name.split("+"):
            weight *= self.prior.get(part, 1.0)
        return weight
