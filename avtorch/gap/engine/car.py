"""A hypothesis as a plant of the simulator, and a user's plant as the baseline of hypotheses."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import fields
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from avtorch.arrays import FloatArray
from avtorch.gap.engine.coordinates import EFFECTS, INDEX, base_name, neutral_values
from avtorch.gap.simulator.effect import EFFECTS as TABLE
from avtorch.gap.simulator.effect import Effect
from avtorch.gap.simulator.plant import GapPlant, plant
from avtorch.gap.simulator.simulator_input import SimulatorInput

if TYPE_CHECKING:
    from avtorch.gap.engine.hypothesis import Hypothesis


def effect_values(h: Hypothesis, effect: str) -> dict[str, Any]:
    """Fields of the table's effect (keys of `Effect.of`) at the hypothesis's values; times from the first log's
    start."""
    own = EFFECTS[effect]
    out: dict[str, Any] = {c.parameter: c.value(h[c.name]) for c in own.coordinates}
    if effect == "gain_change":
        out["change_s"] = h.onsets[effect]
    elif effect == "gear_shift":
        out["speeds"] = tuple(float(s) for s in h.shift_speeds)
        out["rearm_mps"] = h["shift_hysteresis"]
    elif own.base in ("speed_dependent_lag", "speed_dependent_gain"):
        out["mean_speed"] = h.data.reference_speed
    elif effect == "driveline_oscillation":
        out["quadrature"] = 0.0
    elif effect == "command_hold":
        rows = sum(j - i for i, j in h.lost)
        out["hold_fraction"] = rows / len(h.data.time)
    return out


def table_effect(h: Hypothesis, effect: str) -> Effect:
    """The table's effect at the hypothesis's values."""
    kind, given = EFFECTS[effect].kind or TABLE[base_name(effect)], effect_values(h, effect)
    return kind(**{f.name: given[f.name] for f in fields(kind) if f.name in given})


def plant_of(h: Hypothesis, baseline: GapPlant | None = None) -> GapPlant:
    """The repaired simulator: the baseline's effects, those of the hypothesis, its lag and gain. What sets in later
    acts from the start, but for a change of the gain."""
    own = [table_effect(h, e) for e in h.effects if not e.startswith("~")]
    return plant(own, baseline=baseline, T_L=h["T_L"], K_L=h["K_L"])


def compiled(baseline: GapPlant) -> bool:
    """Whether the compiled plant has all effects of a user's baseline, with its settings."""
    for effect in baseline.effects:
        own = EFFECTS.get(effect.name)
        if own is None or own.kind is not None or TABLE.get(effect.name) is not type(effect):
            return False
        if effect.name in ("gear_shift", "gain_change", "speed_dependent_gain", "speed_dependent_lag"):
            return False
        coordinates = {c.parameter for c in own.coordinates}
        if any(f.name not in coordinates and getattr(effect, f.name) != f.default for f in fields(effect)):
            return False  # a setting that no coordinate has
    return True


def neutral_of(baseline: GapPlant) -> FloatArray:
    """The value vector (parameter,) of a baseline, as far as the compiled plant has its effects."""
    out = neutral_values()
    out[INDEX["T_L"]], out[INDEX["K_L"]] = float(baseline.T_L), float(baseline.K_L)
    for effect in baseline.effects if compiled(baseline) else ():
        own: Mapping[str, Any] = {f.name: getattr(effect, f.name) for f in fields(effect)}
        for c in EFFECTS[effect.name].coordinates:
            value = own[c.parameter]
            out[INDEX[c.name]] = c.coordinate(float(value)) if value is not None else math.nan
    return out


def simulator_signals(
    h: Hypothesis, values: FloatArray, onsets: FloatArray | None = None
) -> tuple[FloatArray, FloatArray]:
    """What `Hypothesis.on_grid` returns, by the simulator itself, which also has a user's own effects.

    An effect that sets in during the drive is spliced: its response from then on, the other one's before.
    """
    acts = h.onset_vector() if onsets is None else onsets
    with_all = h.copy()
    with_all.values = values
    time = h.data.grid.time
    if "gain_change" in h.effects:  # has its moment in its own equation
        onset = float(acts[INDEX[EFFECTS["gain_change"].coordinates[0].name]])
        with_all.onsets["gain_change"] = max(onset, float(time[0]) - math.exp(values[INDEX["gain_ramp"]]))
    accel, gained = _signals(with_all)
    for e in h.effects:
        own = EFFECTS[e].coordinates
        since = acts[INDEX[own[0].name]] if own else -np.inf
        if since <= time[0] or e == "gain_change":
            continue
        before_accel, before_gained = _signals(with_all.without(e))
        row = int(np.searchsorted(time, since))
        accel = np.concatenate([before_accel[:row], accel[row:]])
        jump = before_gained[row] - gained[row]
        end = np.flatnonzero(h.data.grid.starts[row + 1 :])
        until = row + 1 + int(end[0]) if len(end) else len(time)
        gained = np.concatenate([before_gained[:row], gained[row:until] + jump, gained[until:]])
    return accel, gained


def _signals(h: Hypothesis) -> tuple[FloatArray, FloatArray]:
    car = plant_of(h, h.baseline)
    with torch.inference_mode():
        responses = [car.response(drive) for drive in drives_of(h)]
    gained = [r.speed_measured - r.speed_measured[0] for r in responses]
    return torch.cat([r.accel_measured for r in responses]).numpy(), torch.cat(gained).numpy()


def drives_of(h: Hypothesis) -> Iterator[SimulatorInput]:
    """The stretches of a hypothesis's drives as the simulator's inputs, on the grid."""
    grid, command = h.data.grid, h.command()[h.data.grid.row]
    for i, j in pairwise([*np.flatnonzero(grid.starts).tolist(), len(grid.time)]):
        speed = None if h.data.speed is None else torch.as_tensor(grid.speed[i:j])
        time, sent = torch.as_tensor(grid.time[i:j]), torch.as_tensor(command[i:j])
        yield SimulatorInput(time, sent, speed, float(grid.accel0[i]), h.data.accel_kind == "specific-force")
