"""A hypothesis: a set of effects with values of their parameters, what it predicts, and the plant that it makes."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from itertools import pairwise
from typing import Any, Self

import numpy as np
import torch

from avtorch.arrays import FloatArray
from avtorch.gap.engine.compiled_plant import read_late, simulate
from avtorch.gap.engine.coordinates import COORDINATES, EFFECTS, FROM_THE_START, INDEX, base_name, neutral_values
from avtorch.gap.engine.drive_data import DriveData
from avtorch.gap.engine.force_map import ForceMap, MapForm
from avtorch.gap.engine.likelihood import log_likelihood
from avtorch.gap.engine.shape_error import ShapeLikelihood
from avtorch.gap.simulator.effect import EFFECTS as TABLE
from avtorch.gap.simulator.effect import Effect
from avtorch.gap.simulator.plant import GapPlant, plant
from avtorch.gap.simulator.simulator_input import SimulatorInput

_LIMITS: Mapping[str, tuple[float, float]] = {
    "T_L": (0.02, 4.0),
    "K_L": (0.1, 4.0),
    "accel_delay": (-0.025, 0.2),
    "speed_delay": (-0.01, 0.25),
    "accel_filter": (0.0, 0.15),
    "speed_filter": (0.0, 0.15),
}
_ALONE_S = -0.15  # least delay where one channel, or the band below `ONE_CHANNEL_HZ`, cannot tell it from the car's


@dataclass(eq=False)
class Hypothesis:
    """`effects` (keys of `coordinates.EFFECTS`) at `values` (parameter,); those in `onsets` act from that time [s] on.

    `neutral` (parameter,): the user's baseline, GLVD where it has no effects. `shift_speeds` (gear,) [m/s], rising.
    `lost`: stretches of rows (from, to) whose commands did not arrive. `alone`: delays of the recorder may be negative,
    as nothing tells them from the car's. `base`: the fitted hypothesis without effects that gains count from.
    `baseline`: the user's plant, where the compiled one does not have all of its effects. `force`: the car's force
    beyond K u as an unnamed part of the base, at `force_coefficients` (curve,); `plain`, of a base with a force: the
    one without it, over which its gain counts.

    `evaluate` sets `predicted` and `residual` (channel, frame, bin), `log_likelihood` [nats] with the noise integrated
    out, and the noise's `covariance` (band, channel, channel) at its maximum. A fit sets `force_columns`, derivatives
    by the map's coefficients and where they are from, and beside a map `force_spread` (band, channel, channel), what
    the response may still be wrong by. `evidence.evaluate_evidence` sets the
    rest.
    """

    data: DriveData
    values: FloatArray = field(default_factory=neutral_values)
    effects: list[str] = field(default_factory=list)
    onsets: dict[str, float] = field(default_factory=dict)
    shift_speeds: FloatArray = field(default_factory=lambda: np.zeros(0))
    lost: tuple[tuple[int, int], ...] = ()
    neutral: FloatArray = field(default_factory=neutral_values)
    alone: bool = False
    base: Hypothesis | None = None
    baseline: GapPlant | None = None
    force: MapForm | None = None
    force_coefficients: FloatArray = field(default_factory=lambda: np.zeros(0))
    plain: Hypothesis | None = field(default=None, repr=False)

    predicted: FloatArray = field(init=False, repr=False)
    residual: FloatArray = field(init=False, repr=False)
    covariance: FloatArray = field(init=False, repr=False)
    log_likelihood: float = field(init=False, default=-np.inf)

    jacobian: FloatArray | None = field(init=False, default=None, repr=False)
    information: FloatArray = field(init=False, repr=False)
    force_columns: tuple[FloatArray, FloatArray] | None = field(init=False, default=None, repr=False)
    force_spread: FloatArray | None = field(init=False, default=None, repr=False)
    effect_energy: FloatArray | None = field(init=False, default=None, repr=False)
    shape: ShapeLikelihood | None = field(init=False, default=None, repr=False)
    shape_log: FloatArray = field(init=False, repr=False)
    evidence: float = field(init=False, default=-np.inf)
    score: float = field(init=False, default=-np.inf)

    # parameters ------------------------------------------------------------------------------------------------------
    @property
    def free(self) -> list[str]:
        """Names of the coordinates that a fit moves: lag and gain, the recorder's, those of the effects."""
        names = ["T_L", "K_L"]
        for channel in self.data.channels:
            names += [f"{channel}_delay", f"{channel}_filter"]
        return names + [c.name for e in self.effects for c in EFFECTS[e].coordinates]

    def limits(self, name: str) -> tuple[float, float]:
        """Least and greatest value of a coordinate in a fit."""
        if name in COORDINATES:
            return COORDINATES[name].low, COORDINATES[name].high
        low, high = _LIMITS[name]
        return (_ALONE_S if self.alone and name.endswith("_delay") else low), high

    def __getitem__(self, name: str) -> float:
        return float(self.values[INDEX[name]])

    def __setitem__(self, name: str, value: float) -> None:
        self.values[INDEX[name]] = value

    def onset_vector(self) -> FloatArray:
        """Times (parameter,) [s] from which the parameters act."""
        acts = np.full(len(self.values), FROM_THE_START)
        for effect, onset in self.onsets.items():
            for c in EFFECTS[effect].coordinates:
                acts[INDEX[c.name]] = onset
        return acts

    # other hypotheses ------------------------------------------------------------------------------------------------
    def copy(self) -> Self:
        """A copy with the same prediction, if there is one; what evidence has set is left out."""
        other = replace(
            self,
            values=self.values.copy(),
            effects=list(self.effects),
            onsets=dict(self.onsets),
            force_coefficients=self.force_coefficients.copy(),
        )
        for name in ("predicted", "residual", "covariance", "log_likelihood", "force_columns", "force_spread"):
            if hasattr(self, name):
                setattr(other, name, getattr(self, name))
        return other

    def on(self, data: DriveData) -> Self:
        """The same hypothesis about other data of the same rows."""
        other = self.copy()
        other.data = data
        return other.evaluate()

    def with_effect(self, effect: str, start: Sequence[float], onset: float | None = None) -> Self:
        """The hypothesis with one more effect, its coordinates at `start`, within their limits."""
        other = self.copy()
        other.effects.append(effect)
        if onset is not None:
            other.onsets[effect] = onset
        for c, x in zip(EFFECTS[effect].coordinates, start, strict=True):
            other[c.name] = min(max(x, c.low), c.high)
        return other

    def without(self, effect: str) -> Self:
        """The hypothesis without an effect, whose coordinates go back to the baseline's."""
        other = self.copy()
        other.effects.remove(effect)
        other.onsets.pop(effect, None)
        for c in EFFECTS[effect].coordinates:
            other[c.name] = self.neutral[INDEX[c.name]]
        if effect == "command_hold":
            other.lost = ()
        return other

    def without_map(self) -> Self:
        """The hypothesis without its force map, not evaluated; itself where it has none."""
        if self.force is None:
            return self
        other = self.copy()
        other.base, other.plain, other.force, other.force_coefficients = self.plain, None, None, np.zeros(0)
        other.force_columns = other.force_spread = None
        return other

    @property
    def names(self) -> tuple[str, ...]:
        """Its effects by the table's names."""
        return tuple(dict.fromkeys(base_name(e) for e in self.effects))

    # prediction -------------------------------------------------------------------------------------------------------
    @property
    def force_map(self) -> ForceMap | None:
        """The car's force beyond K u, where it has one."""
        return None if self.force is None else self.force.force_map(self.force_coefficients)

    def command(self, values: FloatArray | None = None) -> FloatArray:
        """Commands (row,) [m/s²] as they arrived: lost ones are replaced by the last one before. With a force map, what
        a car of gain K would need to do the same: F(u, v) / K, K being that of `values` (parameter,) where given."""
        out = self.data.command
        if self.lost:
            out = out.copy()
            for i, j in self.lost:
                out[i:j] = self.data.command[max(i - 1, 0)]
        if self.force is None:
            return out
        if self.lost:
            more = self.force.force_map(self.force_coefficients)(out, self.data.smooth_speed)
        else:
            more = self.force_coefficients @ self.force.demands
        return out + more / (self.values if values is None else values)[INDEX["K_L"]]

    def on_grid(
        self, values: FloatArray | None = None, onsets: FloatArray | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """The accelerometer's reading [m/s²] and the speed gained in its stretch [m/s] on the grid, (grid,) each."""
        p = self.values if values is None else values
        grid = self.data.grid
        if self.baseline is not None or any(EFFECTS[e].kind is not None for e in self.effects):
            return simulator_signals(self, p, onsets)
        accel, gained = np.empty(len(grid.time)), np.empty(len(grid.time))
        simulate(
            p,
            self.onset_vector() if onsets is None else onsets,
            grid.time,
            self.command(p)[grid.row],
            grid.speed,
            grid.starts,
            grid.accel0,
            self.shift_speeds,
            self.data.reference_speed,
            accel,
            gained,
        )
        return accel, gained

    def recorder_rows(
        self, accel: FloatArray, gained: FloatArray, values: FloatArray | None = None
    ) -> tuple[FloatArray | None, FloatArray | None]:
        """Acceleration and gained speed (grid,) as the recorder shows them: (row,), delayed, filtered, held; None where
        a channel was not recorded."""
        p = self.values if values is None else values
        data, grid = self.data, self.data.grid
        a = v = None
        if data.accel is not None:
            a = np.empty(len(data.time))
            read_late(data.time, grid.time, accel, p[INDEX["accel_delay"]], a)
            a = data.low_pass(a, p[INDEX["accel_filter"]])
        if data.speed is not None:
            v = np.empty(len(data.time))
            read_late(data.time, grid.time, gained, p[INDEX["speed_delay"]], v)
            v = data.held(data.low_pass(v, p[INDEX["speed_filter"]]))
        return a, v

    def recorded(self, accel: FloatArray, gained: FloatArray, values: FloatArray | None = None) -> list[FloatArray]:
        """The same as the channels that are compared, (row,) each."""
        return self.data.channel_rows(*self.recorder_rows(accel, gained, values))

    def rows(self, values: FloatArray | None = None, onsets: FloatArray | None = None) -> list[FloatArray]:
        """The response (row,) [m/s²] of each channel, at other `values` or `onsets` (parameter,) where given."""
        return self.recorded(*self.on_grid(values, onsets), values)

    def response(self, values: FloatArray | None = None, onsets: FloatArray | None = None) -> FloatArray:
        """The response in coefficients (channel, frame, bin)."""
        return self.data.transform(self.rows(values, onsets))

    def evaluate(self) -> Self:
        """Predict and compare."""
        self.predicted = self.response()
        self.residual = self.data.measured - self.predicted
        self.log_likelihood, self.covariance = log_likelihood(self.data, self.residual, self.force_spread)
        return self


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
        felt, place = h.data.accel_kind == "specific-force", float(h.data.position[grid.row[i]])
        yield SimulatorInput(time, sent, speed, float(grid.accel0[i]), felt, place)
