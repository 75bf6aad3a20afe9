"""What is done with each log of a fleet, by the options of `check`, `estimate` and `diagnose`."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields
from typing import Any, Literal, get_args

from avtorch.errors import InputError, quoted

Step = Literal["check", "estimate", "diagnose"]
STEPS: tuple[Step, ...] = get_args(Step)
"""In the order in which they are done."""


def _of(steps: tuple[Step, ...], value: Any) -> Any:
    """A field with a default `value` that changes the rows of these `steps` alone."""
    return field(default=value, metadata={"steps": steps})


@dataclass(frozen=True)
class FleetSettings:
    """The settings of a fleet, one for all its logs.

    `steps`: which of check, estimate and diagnose. `map`, `unit`, `stamp`: names, units and clocks of columns as in
    `Log.read`. Of `estimate`: `window` [s], `estimator`, the controller's `time_gap` [s] and `gains` (k_s, k_v, k_a),
    `accepted` (T_L [s], K_L) of a sound car, `dead_time` [s], None to infer it. Of `diagnose`: `baseline` "glvd", or
    effects such as `dead_time=0.2`, or the text of a TOML file; `effects` by name, None for all; `pairs`, `posterior`,
    `budget_s` for each log. `seed` of everything random. A car whose P(string stable) is below `target` comes first.

    Raises `InputError` for a step that is not known or none, and for values out of range.

    Example:
        >>> from avtorch.fleet import FleetSettings
        >>> settings = FleetSettings(steps=("estimate", "check"), accepted=(0.4, 0.9))
        >>> settings.steps
        ('check', 'estimate')
    """

    steps: tuple[Step, ...] = STEPS
    map: tuple[str, ...] = _of(STEPS, ())
    unit: tuple[str, ...] = _of(STEPS, ())
    stamp: tuple[str, ...] = _of(STEPS, ())
    window: float = _of(("estimate",), 2.0)
    estimator: str = _of(("estimate",), "auto")
    time_gap: float = _of(("estimate",), 1.0)
    gains: tuple[float, float, float] = _of(("estimate",), (1.5, 1.5, -0.8))
    accepted: tuple[float, float] = _of(("estimate",), (0.3, 1.0))
    dead_time: float | None = _of(("estimate",), None)
    baseline: str = _of(("diagnose",), "glvd")
    effects: tuple[str, ...] | None = _of(("diagnose",), None)
    pairs: bool = _of(("diagnose",), True)
    posterior: Literal["laplace", "sgld"] = _of(("diagnose",), "sgld")
    budget_s: float | None = _of(("diagnose",), None)
    seed: int = _of(("estimate", "diagnose"), 0)
    target: float = 0.9

    def __post_init__(self) -> None:
        for step in self.steps:
            if step not in STEPS:
                raise InputError(f"steps: found {quoted(str(step))}, needs some of {', '.join(STEPS)}")
        if not self.steps:
            raise InputError(f"steps: found none, needs some of {', '.join(STEPS)}")
        object.__setattr__(self, "steps", tuple(step for step in STEPS if step in self.steps))
        for name in ("window", "time_gap", "budget_s"):
            value = getattr(self, name)
            if value is not None and not (math.isfinite(value) and value > 0):
                raise InputError(f"{name}: found {value:g}, needs a finite number above 0 s")
        if self.dead_time is not None and not 0 <= self.dead_time < self.window:
            raise InputError(f"dead_time: found {self.dead_time:g} s, needs 0 or more and less than the window")
        if not 0 < self.target < 1:
            raise InputError(f"target: found {self.target:g}, needs a probability between 0 and 1, such as 0.9")
        if not 0 <= self.seed < 2**63:
            raise InputError(f"seed: found {self.seed}, needs a whole number from 0 to 2^63 - 1")

    def of(self, step: Step) -> dict[str, Any]:
        """The settings that change the rows of `step`."""
        return {f.name: getattr(self, f.name) for f in fields(self) if step in f.metadata.get("steps", ())}

    def refuse_unknown(self) -> None:
        """Raises `InputError` for names that no log could make right: of signals, effects and the baseline's."""
        from avtorch.io.mapping import read_mapping

        read_mapping("", map=self.map or None, unit=self.unit or None, stamp=self.stamp or None)
        # the rest needs torch, which a call with nothing to compute does not
        if self.estimator != "auto":
            from avtorch.inference.estimators import ESTIMATORS

            if self.estimator not in ESTIMATORS:
                raise InputError(f"estimator: found {quoted(self.estimator)}, needs auto, {', '.join(ESTIMATORS)}")
        if self.effects is not None:
            from avtorch.gap.simulator.effect import effect_class

            for name in self.effects:
                effect_class(name)
        if self.baseline != "glvd":
            from avtorch.gap.simulator.plant import GapPlant

            GapPlant.from_toml(self.baseline)
