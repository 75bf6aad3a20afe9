"""Scores of answers to recordings with a known effect in front of them, each beside the answer to the untouched log.

What else a recorded car lacks is not known, so an answer is scored by its difference from that of its control: is the
effect named, is its size what was added to the size that the control already had, and is any name new that was not put
in.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from benchmarks.blindtest.answered_budget import read_budget
from benchmarks.blindtest.answers import canonical_name
from benchmarks.blindtest.intervals import cases_for, wilson

SIZE_WITHIN = 0.25
"""A size is right within this share of what was put in."""
_NOTHING = ("none", "unknown")


def _sum(found: float, before: float, put_in: float) -> float | None:
    return (found - before) / put_in


def _ratio(found: float, before: float, put_in: float) -> float | None:
    """Factors multiply: compared as logarithms, so that a gain of 0.65 is as far from 1 as one of 1/0.65."""
    return math.log(found / before) / math.log(put_in) if min(found, before) > 0 else None


def _squares(found: float, before: float, put_in: float) -> float | None:
    """Independent disturbances add in squares."""
    return math.sqrt(max(found**2 - before**2, 0.0)) / put_in


def _stricter(found: float, before: float, put_in: float) -> float | None:
    """Of two limits only the stricter one is seen."""
    return found / min(before, put_in)


SIZE_OF: Mapping[str, tuple[str, float, Callable[[float, float, float], float | None]]] = {
    "dead_time": ("delay_s", 0.0, _sum),
    "dead_band": ("half_width_mps2", 0.0, _sum),
    "backlash": ("half_width_mps2", 0.0, _sum),
    "brake_throttle_asymmetry": ("brake_gain_ratio", 1.0, _ratio),
    "gain_change": ("gain_ratio", 1.0, _ratio),
    "speed_dependent_gain": ("gain_slope", 0.0, _sum),
    "saturation": ("accel_max_mps2", math.inf, _stricter),
    "constant_resistance": ("resistance_mps2", 0.0, _sum),
    "aerodynamic_drag": ("drag_per_m", 0.0, _sum),
    "road_grade": ("grade_rms", 0.0, _squares),
    "low_speed_creep": ("creep_mps2", 0.0, _sum),
    "gust": ("sd_mps2", 0.0, _squares),
    "sensor_bias": ("bias_mps2", 0.0, _sum),
    "sensor_scale": ("scale", 1.0, _ratio),
    "sensor_lag": ("lag_s", 0.0, _sum),
    "outliers": ("fraction", 0.0, _sum),
}
"""By effect: the parameter that is its size, its value without the effect, and how a second one adds to a first.

A diagnosis gives the size of outliers in units of a noise that nobody knows, so their share is compared instead.
"""


@dataclass(frozen=True)
class Injected:
    """One `effect` of relative `size` in front of the recording `background`.

    `put_in`: its parameters; `control`, `answer`: what was said of the untouched log and of the changed one (dicts of
    `avtorch.diagnosis/1` or `/2`; None: no answer).

    Example:
        >>> from benchmarks.blindtest import Injected
        >>> said = (["gust"], ["gust", "dead_time"])
        >>> control, answer = ({"verdict": {"names": names}, "effects": []} for names in said)
        >>> trial = Injected("lap", "dead_time", 1.0, {"delay_s": 0.3}, control, answer)
        >>> trial.held, trial.extra, trial.size_ratio  # the answer gives no size
        (True, (), None)
    """

    background: str
    effect: str
    size: float
    put_in: Mapping[str, float]
    control: Mapping[str, Any]
    answer: Mapping[str, Any] | None

    @property
    def names(self) -> tuple[str, ...] | None:
        """The verdict's names; None where there is no answer."""
        return None if self.answer is None else tuple(self.answer["verdict"]["names"])

    @property
    def held(self) -> bool:
        """Whether the verdict names the effect, alone or among others."""
        return self.effect in (self.names or ())

    @property
    def in_control(self) -> bool:
        """Whether the untouched log's verdict names it too."""
        return self.effect in self.control["verdict"]["names"]

    @property
    def size_ratio(self) -> float | None:
        """The size found on top of the control's, over the size put in; None where the answer gives none."""
        parameter, without, relative = SIZE_OF[self.effect]
        found = _quantity(self.answer, self.effect, parameter)
        before = {"mean": without} if not self.in_control else _quantity(self.control, self.effect, parameter)
        if found is None or before is None:
            return None
        return relative(float(found["mean"]), float(before["mean"]), self.put_in[parameter])

    @property
    def covered(self) -> bool | None:
        """Whether the 90 % interval of the size holds what was put in; None without an interval, and where the control
        has the effect too."""
        parameter = SIZE_OF[self.effect][0]
        found = _quantity(self.answer, self.effect, parameter)
        if found is None or self.in_control or not {"q05", "q95"} <= found.keys():
            return None
        return bool(found["q05"] <= self.put_in[parameter] <= found["q95"])

    @property
    def size_right(self) -> bool | None:
        """Whether that is within a quarter of 1."""
        ratio = self.size_ratio
        return None if ratio is None else abs(ratio - 1) <= SIZE_WITHIN + 1e-12

    @property
    def extra(self) -> tuple[str, ...]:
        """Names in the verdict that are neither put in nor in the control's."""
        known = {self.effect, *_NOTHING, *self.control["verdict"]["names"]}
        return tuple(name for name in self.names or () if name not in known)

    @property
    def nothing_named(self) -> bool:
        """Whether the verdict is `unknown`, `none` or empty."""
        return self.names is not None and set(self.names) <= set(_NOTHING)

    def to_dict(self) -> dict[str, Any]:
        return {
            "background": self.background,
            "effect": self.effect,
            "size": self.size,
            "put_in": dict(self.put_in),
            "answered": self.answer is not None,
            "names": list(self.names or ()),
            "control": list(self.control["verdict"]["names"]),
            "held": self.held,
            "in_control": self.in_control,
            "size_ratio": self.size_ratio,
            "size_right": self.size_right,
            "covered": self.covered,
            "extra": list(self.extra),
            "nothing_named": self.nothing_named,
        }


def score_in_front(trials: Sequence[Injected]) -> dict[str, Any]:
    """Counts by effect and size (`table`), by size (`by_size`), and over all trials (`totals`).

    Rows are in the order of their first trial. Of the `trials`, `held` counts those whose verdict names the effect,
    `in_control` those whose control names it too, `sized` those held with a size in the answer, and `size_right` those
    of them within a quarter of what was put in; `extra` those with a name that neither control nor injection has,
    `nothing_named` those answered `unknown`, `none` or nothing, `failed` those without an answer. Of the `bounded`,
    whose size has an interval and is not in the control, `covered` counts those whose interval holds it. `by_size` and
    `totals` also have shares with Wilson's 90 % intervals: of the trials, but `size_right` of the `sized` and `covered`
    of the `bounded`; and in `needed` how many of these make an interval of ± 5 points.

    Example:
        >>> from benchmarks.blindtest import Injected, score_in_front
        >>> unknown = {"verdict": {"names": ["unknown"]}, "effects": []}
        >>> late = {"verdict": {"names": ["dead_time"]}, "effects": [
        ...     {"name": "dead_time", "probability": 1.0, "parameters": {"delay_s": {"mean": 0.28}}}]}
        >>> put_in = {"delay_s": 0.3}
        >>> trials = [Injected("lap", "dead_time", 1.0, put_in, unknown, answer) for answer in (late, unknown)]
        >>> totals = score_in_front(trials)["totals"]
        >>> totals["held"], totals["size_right"], totals["shares"]["held"], totals["nothing_named"]
        (1, 1, 0.5, 1)
    """
    cells: dict[tuple[str, float], list[Injected]] = {}
    for one in trials:
        cells.setdefault((one.effect, one.size), []).append(one)
    table = [{"effect": effect, "size": size, **_counts(some)} for (effect, size), some in cells.items()]
    sizes = sorted({one.size for one in trials})
    by_size = [{"size": size, **_with_shares([one for one in trials if one.size == size])} for size in sizes]
    return {"table": table, "by_size": by_size, "totals": _with_shares(trials)}


SHARES_OF: Mapping[str, str] = {
    "held": "trials",
    "size_right": "sized",
    "covered": "bounded",
    "extra": "trials",
    "nothing_named": "trials",
}
"""What is counted, by the count that it is a share of."""


def _with_shares(trials: Sequence[Injected]) -> dict[str, Any]:
    totals = _counts(trials)
    shares = {key: totals[key] / totals[n] if totals[n] else None for key, n in SHARES_OF.items()}
    intervals = {key: wilson(totals[key], totals[n]) for key, n in SHARES_OF.items()}
    known = {key: None if interval is None else list(interval) for key, interval in intervals.items()}
    needed = {key: cases_for(totals[key], totals[n]) for key, n in SHARES_OF.items()}
    return {**totals, "shares": shares, "intervals": known, "needed": needed}


def _counts(trials: Sequence[Injected]) -> dict[str, int]:
    sized = [one for one in trials if one.held and one.size_right is not None]
    bounded = [one for one in trials if one.held and one.covered is not None]
    return {
        "trials": len(trials),
        "held": sum(one.held for one in trials),
        "in_control": sum(one.in_control for one in trials),
        "sized": len(sized),
        "size_right": sum(bool(one.size_right) for one in sized),
        "bounded": len(bounded),
        "covered": sum(bool(one.covered) for one in bounded),
        "extra": sum(bool(one.extra) for one in trials),
        "nothing_named": sum(one.nothing_named for one in trials),
        "failed": sum(one.answer is None for one in trials),
    }


def _quantity(answer: Mapping[str, Any] | None, effect: str, parameter: str) -> Mapping[str, Any] | None:
    """A parameter of an effect that the verdict names: in the budget, or under the verdict, where a set of effects has
    it as `effect.parameter`. None where it is not there, or has no finite mean."""
    if answer is None or effect not in answer["verdict"]["names"]:
        return None
    budget = read_budget(answer)
    part = None if budget is None else budget.part(effect)
    quantity = None if part is None else part.parameters.get(parameter)
    name = canonical_name(answer["verdict"]["names"])
    for entry in answer["effects"]:
        if quantity is None and canonical_name(entry["name"]) == name:
            quantity = entry["parameters"].get(parameter if name == effect else f"{effect}.{parameter}")
    return quantity if quantity is not None and math.isfinite(quantity["mean"]) else None
