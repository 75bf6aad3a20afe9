"""Effects switched on and off and their sizes moved: the rollout of the simulator so changed, and its error."""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from os import PathLike
from pathlib import Path

import numpy as np

from avtorch.arrays import FloatArray
from avtorch.errors import InputError
from avtorch.gap import EFFECTS, Effect, GapPlant, plant
from avtorch.gap.result.counted_rows import CountedRows
from avtorch.gap.result.traces import Traces
from avtorch.io import Log


@dataclass(frozen=True)
class Size:
    """A parameter that can be moved from `low` to `high`, its typical range, or wider where its `value` is."""

    value: float
    low: float
    high: float
    unit: str


@dataclass(frozen=True, eq=False)
class Trial:
    """A drive, the `base` simulator fitted to it, and the `car`: that simulator repaired.

    Example:
        >>> from avtorch import Leader, diagnose, simulate
        >>> from avtorch.gap import SensorBias, plant
        >>> from avtorch.remedy import Trial
        >>> tilted = plant([SensorBias(0.3)], sigma=0.0)
        >>> log = simulate(Leader.default(start=50.0, duration=14.0, dt=0.05), plant=tilted).log()
        >>> _ = diagnose(log, effects=["sensor_bias"], pairs=False).write("out")
        >>> trial = Trial.of(log, "out")
        >>> _, errors = trial.rollout(trial.car, ["sensor_bias"], {"sensor_bias.bias_mps2": 0.1})
        >>> round(errors["accel"], 1)  # of 0.3 m/s² two thirds are missing again
        0.2
    """

    rows: CountedRows = field(repr=False)
    base: GapPlant
    car: GapPlant

    @classmethod
    def of(cls, log: Log, answer: str | PathLike[str]) -> Trial:
        """From a log and the folder of its diagnosis. Raises `InputError` where a file of that is missing or damaged,
        and for a log without `accel_cmd`."""
        answer = Path(answer)
        try:
            found = json.loads((answer / "diagnosis.json").read_text(encoding="utf-8"))
            lag, gain = (float(found["baseline"][name]["mean"]) for name in ("T_L", "K_L"))
        except (OSError, ValueError, KeyError, TypeError) as fault:
            raise InputError(f"{answer / 'diagnosis.json'}: cannot be read ({fault})") from None
        base, repaired = plant([], T_L=lag, K_L=gain, sigma=0.0), answer / "plant.toml"
        return cls(CountedRows.of(log), base, plant([], baseline=repaired) if repaired.exists() else base)

    @property
    def traces(self) -> Traces:
        """What was measured."""
        measured = self.rows.measured
        return Traces.of(self.rows, measured, measured, np.zeros(self.rows.rows))

    def sizes(self, car: GapPlant) -> dict[str, Size]:
        """What can be moved, by the names of `GapPlant.parameters`."""
        out, values = {}, car.values()
        for key, p in car.parameters().items():
            if p.reported and key in values and values[key].numel() == 1:
                value = float(values[key])
                ends = [p.low, p.high, value, 0.6 * value, 1.4 * value, *([] if p.neutral is None else [p.neutral])]
                known = [x for x in ends if np.isfinite(x)]
                out[key] = Size(value, min(known), max(known), "" if p.unit == "-" else p.unit)
        return out

    def addable(self) -> list[str]:
        """Effects that the car lacks and a rollout can show."""
        own, channels = {e.name for e in self.car.effects}, self.rows.channels
        return [
            name
            for name, kind in sorted(EFFECTS.items())
            if not (name in own or kind.random or (kind.needs_speed and "speed" not in channels))
            and not (kind.place == "sensor" and "accel" not in channels)
            and kind.drawn is Effect.drawn  # a road's profile is fitted, not set
            and any(key.startswith(f"{name}.") for key in self.sizes(self.with_effect(self.car, name)))
        ]

    def with_effect(self, car: GapPlant, name: str) -> GapPlant:
        """`car` with one more effect, of typical size."""
        return plant(plant([EFFECTS[name]]).prepared(*self.rows.drives).effects, baseline=car)

    def rollout(
        self, car: GapPlant, on: Collection[str], values: Mapping[str, float]
    ) -> tuple[FloatArray, dict[str, float]]:
        """Lines (channel, row) of `car` with the effects that are `on` at these values, and the RMS errors of its
        rollouts over 10 s by channel. Raises `InputError` for sizes that it cannot have."""
        left = GapPlant([e for e in car.effects if e.name in on], T_L=car.T_L, K_L=car.K_L, sigma=0.0)
        there = left.parameters()
        left = left.with_values({key: x for key, x in values.items() if key in there})
        lines = self.rows.rolled_out(left)
        if not np.isfinite(lines).all():
            raise InputError("the simulator diverges with these sizes; needs others")
        return self.traces.begun_anew(lines.mean(-1)), self.rows.rms(self.rows.measured - lines)
