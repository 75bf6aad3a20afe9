"""GLVD with some effects as a function of one vector: what it does to the channels of a record.

The coordinates are those of the effects' priors, standard normal each, and kept within what physics allows. An effect
may set in during the drives: before its onset the model is the one without it. Recorders do not read two channels at
the same moment (filters, holds, clocks that differ): speed has a lateness against the accelerometer, which is no cause.
Where speed is all there is it has one against the command, up to what a recorder's filter makes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from torch import Tensor

from avtorch.arrays import BoolArray, FloatArray
from avtorch.gap.budget.analysis_record import AnalysisRecord, Stretch, later, stacked
from avtorch.gap.simulator.effect import Effect
from avtorch.gap.simulator.integrated import Integrated
from avtorch.gap.simulator.parameter import Parameter
from avtorch.gap.simulator.plant import GapPlant, plant

LATENESS = "recorder.lateness"
"""The coordinate that is no parameter of an effect: how late speed is read against acceleration, or the command."""
LATENESS_S = 0.04  # its standard deviation [s]
_FILTERED = 2.0  # prior standard deviations, as late as a recorder's filter, hold and clock make speed by itself
_BEYOND = 3.0  # times as far as physics allows
_WIDEST = 6.0  # prior standard deviations, where physics sets no limit
_AT_LIMIT = 0.02  # prior standard deviations from a limit
_BEHIND = ("body", "sensor")  # places of the chain behind the actuator


@dataclass(frozen=True, eq=False)
class EffectModel:
    """`effects` on top of `base`, whose own effects keep their values; `T_L` and `K_L` are free.

    `onsets` [s from a log's start] by effect, of those that set in during the drives; before, the base's own of that
    kind acts, if it has one.
    """

    record: AnalysisRecord
    base: GapPlant
    effects: tuple[type[Effect], ...] = ()
    onsets: Mapping[str, float] = field(default_factory=dict)
    plant: GapPlant = field(init=False)
    index: Mapping[str, slice] = field(init=False)
    roads: Mapping[str, Integrated] = field(init=False)
    low: FloatArray = field(init=False)
    high: FloatArray = field(init=False)

    def __post_init__(self) -> None:
        own = {e.name for e in self.effects}
        kept = {e.name: self.base.kept(e) for e in self.effects}
        effects = [kept[e.name] or _coarse(e(), self.record) for e in self.effects]
        new = [name for name, effect in kept.items() if effect is None]
        whole = plant(effects, baseline=self.base).prepared(*(s.drive for s in self.record.stretches), fitted=new)
        index: dict[str, slice] = {}
        low: list[float] = []
        high: list[float] = []
        for key, parameter in whole.parameters().items():
            effect = key.partition(".")[0]
            if effect not in {"T_L", "K_L", *own} or key in _sizes(self.effects):
                continue
            if parameter.of_onset and effect not in self.onsets:  # the same as a change of T_L or K_L
                continue
            index[key] = slice(len(low), len(low) + parameter.size)
            ends = _box(parameter)
            low += [ends[0]] * parameter.size
            high += [ends[1]] * parameter.size
        if "speed" in self.record.channels:
            beside = len(self.record.channels) == 2
            index[LATENESS] = slice(len(low), len(low) + 1)
            low.append(-_WIDEST if beside else 0.0)
            high.append(_WIDEST if beside else _FILTERED)
        roads = {
            f"{e.name}.{p.name}": e
            for e in whole.effects
            if isinstance(e, Integrated) and e.name in new
            for p in e.coordinates()
            if p.size > 1
        }
        made = {"plant": whole, "index": index, "roads": roads, "low": np.array(low), "high": np.array(high)}
        for name, value in made.items():
            object.__setattr__(self, name, value)

    @property
    def size(self) -> int:
        return len(self.low)

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(e.name for e in self.effects)

    @property
    def along(self) -> BoolArray:
        """The coordinates (size,) in which the response is linear: those of forces along the road."""
        return self._of(lambda key, effect: key in self.roads)

    @property
    def behind(self) -> BoolArray:
        """The coordinates (size,) that leave the actuator as it is: those of forces and sensors."""
        return self._of(lambda key, effect: key == LATENESS or (effect is not None and effect.place in _BEHIND))

    def _of(self, chosen: Callable[[str, type[Effect] | None], bool]) -> BoolArray:
        kinds, out = {e.name: e for e in self.effects}, np.zeros(self.size, dtype=bool)
        for key, at in self.index.items():
            out[at] = chosen(key, kinds.get(key.partition(".")[0]))
        return out

    def of_the_road(self) -> EffectModel:
        """Forces along the road, and what reads them. What a further one adds depends on nothing else."""
        kept = {e.name for e in self.effects if issubclass(e, Integrated) or e.place == "sensor"}
        onsets = {name: onset for name, onset in self.onsets.items() if name in kept}
        return replace(self, effects=tuple(e for e in self.effects if e.name in kept), onsets=onsets)

    def with_effect(self, effect: type[Effect]) -> EffectModel:
        return replace(self, effects=(*self.effects, effect))

    def without(self, name: str) -> EffectModel:
        onsets = {key: value for key, value in self.onsets.items() if key != name}
        return replace(self, effects=tuple(e for e in self.effects if e.name != name), onsets=onsets)

    def setting_in(self, name: str, onset: float) -> EffectModel:
        return replace(self, onsets={**self.onsets, name: onset})

    def without_onset(self, name: str) -> EffectModel:
        """The model in which an effect acts from the start."""
        return replace(self, onsets={key: onset for key, onset in self.onsets.items() if key != name})

    # coordinates ---------------------------------------------------------------------------------------------------
    def values(self, z: FloatArray) -> dict[str, Tensor]:
        """Parameters by name, (...), of coordinates `z` (..., size)."""
        inside = torch.as_tensor(np.clip(z, self.low, self.high))
        parameters, out = self.plant.parameters(), {}
        for key, at in self.index.items():
            if key == LATENESS:
                continue
            value = parameters[key].constrain(inside[..., at])
            if key in self.roads:
                # a slope that is the same everywhere is a constant resistance, which has a name of its own
                value = self.roads[key].levelled(value)
            out[key] = value if parameters[key].size > 1 else value[..., 0]
        return out

    def coordinates(self, known: Mapping[str, FloatArray]) -> FloatArray:
        """A vector (size,) with the coordinates `known` by name, and the prior's centre for the others."""
        z = np.zeros(self.size)
        for key, value in known.items():
            if key in self.index:
                z[self.index[key]] = value
        return z

    def named(self, z: FloatArray) -> dict[str, FloatArray]:
        """`coordinates` undone: by name."""
        return {key: z[at] for key, at in self.index.items()}

    def traded(self, z: FloatArray) -> FloatArray:
        """Places (place, size) where a delay has given some of its time to the lag, or taken it.

        Commands are held within rows, so the likelihood in a delay has a crease at every row, and a mode at some.
        """
        keys = [f"{e.name}.{e.shift}" for e in self.effects if e.shift is not None]
        if not keys:
            return np.empty((0, self.size))
        parameters, values, out = self.plant.parameters(), self.values(z), []
        for seconds in (-0.12, -0.05, -0.02, 0.02, 0.05, 0.12):
            place = z.copy()
            for key, moved in ((keys[0], seconds), ("T_L", -seconds)):
                value = (values[key] + moved).clamp_min(0.01)
                place[self.index[key]] = float(parameters[key].unconstrain(value))
            out.append(np.clip(place, self.low, self.high))
        return np.array(out)

    def at_limit(self, z: FloatArray, effect: str) -> bool:
        """Whether a parameter of `effect` rests where fits end, far beyond what is physically possible."""
        own = [at for key, at in self.index.items() if key.startswith(f"{effect}.")]
        return any(
            bool(((z[at] < self.low[at] + _AT_LIMIT) & (self.low[at] > -_WIDEST)).any())
            or bool(((z[at] > self.high[at] - _AT_LIMIT) & (self.high[at] < _WIDEST)).any())
            for at in own
        )

    # response ------------------------------------------------------------------------------------------------------
    @torch.inference_mode()
    def simulate(self, z: FloatArray) -> FloatArray:
        """Noise-free channels (..., channel, row) [m/s²] of coordinates `z` (..., size).

        What all of these have in common is simulated once.
        """
        values = {key: _shared(value, self.plant.parameters()[key].size > 1) for key, value in self.values(z).items()}
        out = self._late(self._setting_in(values), z)
        return np.broadcast_to(out, (*z.shape[:-1], *out.shape[-2:]))

    def _setting_in(self, values: Mapping[str, Tensor]) -> FloatArray:
        """The response to `values` (...), of which those of an effect that sets in act from its onset on."""
        if not self.onsets:
            return self._simulate(self.plant, values)
        out: FloatArray | None = None
        acting = {e.name: e for e in self.plant.effects if e.name not in self.onsets}
        # until its onset an effect of the baseline acts as the baseline has it
        before = [e for e in self.base.effects if e.name in self.onsets]
        for name, onset in [("", -np.inf), *sorted(self.onsets.items(), key=lambda item: item[1])]:
            acting |= {e.name: e for e in self.plant.effects if e.name == name}
            before = [e for e in before if e.name != name]
            present = GapPlant(
                [*acting.values(), *before], T_L=self.plant.T_L, K_L=self.plant.K_L, sigma=self.plant.sigma
            )
            some = {k: v for k, v in values.items() if "." not in k or k.partition(".")[0] in acting}
            later = self._simulate(present, some)
            out = later if out is None else np.where(self.record.time >= onset, later, out)
        assert out is not None
        return out

    def _late(self, channels: FloatArray, z: FloatArray) -> FloatArray:
        """`channels` (..., channel, row) with the one that is read late as late as it is.

        It is delayed, the other is not advanced: a command that follows what is measured knows the noise of the rows
        before it, and would predict the noise of a row from the commands after it.
        """
        if LATENESS not in self.index:
            return channels
        seconds = LATENESS_S * np.clip(z, self.low, self.high)[..., self.index[LATENESS]]
        out = np.array(np.broadcast_to(channels, (*z.shape[:-1], *channels.shape[-2:])))
        for name, late in (("speed", seconds), ("accel", -seconds)):
            if name not in self.record.channels:
                continue
            channel = self.record.channels.index(name)
            for stretch in self.record.stretches:
                at = (..., channel, stretch.rows)
                out[at] = _delayed(out[at], np.maximum(late, 0.0) / self.record.dt)
        return out

    def _simulate(self, car: GapPlant, values: Mapping[str, Tensor]) -> FloatArray:
        channels = []
        for stretch in self.record.stretches:
            response = car.response(stretch.drive, values)
            gained = response.speed.diff(dim=-1) / self.record.dt
            by_channel = {"speed": torch.cat([gained, gained[..., -1:]], -1), "accel": response.accel_measured}
            channels.append(_averaged(stacked([by_channel[c] for c in self.record.channels]), stretch, self.record.dt))
        return np.concatenate(channels, -1)


def _shared(value: Tensor, long: bool) -> Tensor:
    """`value` (batch, ...) without its batch where it is the same throughout; `long`: of several numbers each."""
    if value.dim() != 1 + long or len(value) < 2 or bool((value != value[0]).any()):
        return value
    return value[0]


def _delayed(x: FloatArray, rows: FloatArray) -> FloatArray:
    """`x` (..., row) so many `rows` (..., 1) later, linear between rows."""
    if not rows.any():
        return x
    whole = np.floor(rows).astype(int)
    least = int(whole.min())
    if least == whole.max():  # the usual case, in which no row has to be looked up
        now, before = (later(x, least + k) for k in (0, 1))
    else:
        place = np.arange(x.shape[-1]) - whole
        now, before = (np.take_along_axis(x, np.maximum(place - k, 0), -1) for k in (0, 1))
    return now + (rows - whole) * (before - now)


def _averaged(x: FloatArray, stretch: Stretch, dt: float) -> FloatArray:
    """`x` (..., row) averaged as the readings were, to second order: `x + s²/2 x''`."""
    if stretch.averaging == 0:
        return x
    out = x.copy()
    out[..., 1:-1] += stretch.averaging / dt**2 * (x[..., 2:] - 2 * x[..., 1:-1] + x[..., :-2])
    return out


def _box(parameter: Parameter) -> tuple[float, float]:
    """Coordinates that a fit may take: what physics allows, and three times as far where that is said in logarithms.

    Of a force along the road physics limits the size, and no coefficient by itself.
    A car beyond what physics allows is a finding, and said to be implausible; one far beyond it is no fit.
    """
    if parameter.constraint == "interval" or parameter.size > 1:
        return -_WIDEST, _WIDEST
    low, high = parameter.physical
    if parameter.constraint == "positive":
        low, high = low / _BEYOND, high * _BEYOND
    elif parameter.constraint == "negative":
        low, high = low * _BEYOND, high / _BEYOND
    ends = [float(parameter.unconstrain(torch.tensor(x, dtype=torch.float64))) for x in (low, high)]
    return max(min(ends), -_WIDEST), min(max(ends), _WIDEST)


def _coarse(effect: Effect, record: AnalysisRecord) -> Effect:
    """A force along the road with knots as far apart as what is driven in a block."""
    return effect.spaced(record.knot_m) if isinstance(effect, Integrated) else effect


def _sizes(effects: Sequence[type[Effect]]) -> set[str]:
    """Of forces along the road: their size, which the coefficients hold already."""
    return {f"{e.name}.{e.size}" for e in effects if issubclass(e, Integrated)}
