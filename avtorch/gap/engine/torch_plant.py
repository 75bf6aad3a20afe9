"""The plant of a hypothesis and its recorder in torch: batched over values of coordinates, differentiable.

It runs the simulator's own effects and actuator on the grid of a drive, stretch by stretch; a test holds it to the
compiled plant. An effect that sets in later is neutral until then. One whose memory would have filled by then (a play,
a ring, a sensor's filter) begins there at rest; an actuator that changes is cut in two there, and its second part
begins at the acceleration which the first has reached.

Where a user's own effect or baseline takes part, the simulator responds as a whole.

The recorder (`recorded`) is the twin of `Hypothesis.recorded` and `DriveData.transform`, with gradients in the signals
and in delays and filters. A delay reads between points of the grid, so that its gradient jumps where a row passes one.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, cast

import numpy as np
import torch
from numba import njit
from torch import Tensor
from torch.autograd.function import once_differentiable

from avtorch.arrays import FloatArray, IntArray
from avtorch.gap.effects.driveline_oscillation import DrivelineOscillation
from avtorch.gap.engine.compiled_plant import _FREE_DAMPING
from avtorch.gap.engine.coordinates import EFFECTS, INDEX, NEUTRAL, Coordinate, base_name
from avtorch.gap.engine.drive_data import UNKNOWN_SPEED_MPS, DriveData, filtered
from avtorch.gap.engine.hypothesis import Hypothesis, drives_of, plant_of, table_effect
from avtorch.gap.simulator.actuator import Actuator, Substep
from avtorch.gap.simulator.chain import at_place, in_order, substeps
from avtorch.gap.simulator.effect import Effect, EffectContext, context_at
from avtorch.gap.simulator.plant import GapPlant
from avtorch.gap.simulator.simulator_input import SimulatorInput

Values = Mapping[str, Tensor]
"""Coordinates by name, (column,) each, or () where all columns share the value."""

_FILLING = frozenset({"backlash", "driveline_oscillation", "sensor_lag", "speed_lag"})
_UNNAMED = "~linear"
_NO_LIMIT = 1e9  # [m/s², m/s³] replaces infinity, whose gradients are undefined


def own_value(c: Coordinate, z: Tensor) -> Tensor:
    """The effect's own parameter at coordinates `z`: `Coordinate.value` of a tensor, but finite without a limit."""
    if c.link == "inverse":
        z = 1 / z.clamp_min(1 / _NO_LIMIT)
    elif c.link == "log":
        z = z.exp()
    elif c.link == "square":
        z = z.clamp_min(1e-16).sqrt()  # its square, which acts, has a derivative at 0
    elif c.link == "less one":
        z = z + 1
    return c.sign * z


def not_in_torch(h: Hypothesis) -> str:
    """Why there is no such plant of a hypothesis; empty where there is one."""
    if h.force is not None:
        return "its force is a map, whose coefficients would be draws, too"
    late = [e for e in h.onsets if e != "gain_change"]
    if late and _by_the_simulator(h):
        return f"{' and '.join(late)} set in beside what the simulator alone has"
    actuator = [e for e in h.effects if EFFECTS[e].base in ("second_order_actuator", "rate_limit")]
    if len(actuator) > 1 and any(e in h.onsets for e in actuator):
        return f"{' and '.join(actuator)} change the actuator at different times"
    return ""


def torch_plant(h: Hypothesis) -> TorchPlant | SimulatorPlant:
    """The plant of a hypothesis for which `not_in_torch` has no reason against it."""
    return SimulatorPlant.of(h) if _by_the_simulator(h) else TorchPlant.of(h)


def _by_the_simulator(h: Hypothesis) -> bool:
    return h.baseline is not None or any(EFFECTS[e].kind is not None for e in h.effects)


@dataclass(frozen=True, eq=False)
class SimulatorPlant:
    """`Hypothesis.on_grid` by the simulator's own plant, for tensors of values."""

    hypothesis: Hypothesis
    plant: GapPlant
    drives: tuple[SimulatorInput, ...]

    @classmethod
    def of(cls, h: Hypothesis) -> SimulatorPlant:
        return cls(h, plant_of(h, h.baseline), tuple(drives_of(h)))

    def on_grid(self, values: Values) -> tuple[Tensor, Tensor]:
        """See `TorchPlant.on_grid`."""
        own = {name: values[name] for name in ("T_L", "K_L")}
        for effect in self.hypothesis.effects:
            for c in EFFECTS[effect].coordinates:
                if c.parameter:
                    own[f"{base_name(effect)}.{c.parameter}"] = own_value(c, values[c.name])
        responses = [self.plant.response(drive, own) for drive in self.drives]
        gained = [r.speed_measured - r.speed_measured[..., :1] for r in responses]
        return torch.cat([r.accel_measured for r in responses], -1), torch.cat(gained, -1)


@dataclass(frozen=True, eq=False)
class TorchPlant:
    """`Hypothesis.on_grid` for tensors of values; `acting`: effects, those of the user's baseline among them."""

    hypothesis: Hypothesis
    acting: tuple[str, ...]
    drives: tuple[SimulatorInput, ...]

    @classmethod
    def of(cls, h: Hypothesis) -> TorchPlant:
        return cls(h, tuple(_acting(h)), tuple(drives_of(h)))

    def on_grid(self, values: Values) -> tuple[Tensor, Tensor]:
        """The accelerometer's reading [m/s²] and the speed's reading gained in its stretch [m/s], (column, grid) each.

        `values`: every coordinate of the vector that differs from the hypothesis's, `T_L` among them.
        """
        parts = [self._over(drive, values) for drive in self.drives]
        accel, gained = zip(*parts, strict=True)
        return torch.cat(accel, -1), torch.cat(gained, -1)

    def _over(self, drive: SimulatorInput, values: Values) -> tuple[Tensor, Tensor]:
        steps, columns = len(drive.time), values["T_L"].shape
        speed = torch.full_like(drive.time, UNKNOWN_SPEED_MPS) if drive.speed is None else drive.speed
        dt = drive.dt[0] if drive.uniform else drive.dt
        row = EffectContext(drive.time, dt, speed, None, values["T_L"][..., None], values["K_L"][..., None])
        late: dict[str, int] = {}
        effects = []
        for name in self.acting:
            first = int(np.searchsorted(row.time.numpy(), self.hypothesis.onsets.get(name, -np.inf)))
            if first < steps:
                effects.append(self._effect(name, values, row.time, first))
                late[effects[-1].name] = first
        chain = in_order(effects)

        def hook(e: Effect, x: Tensor) -> Any:
            force = e.place == "body"
            before = late[e.name] - (not force)
            if before < 1 or e.name not in _FILLING:
                return e.over(x, row)
            rest = replace(row, time=row.time[before:], dt=row.dt[before:] if row.dt.dim() else row.dt)
            after = e.over(x[..., before:], rest)
            without = torch.zeros_like(x) if force else x
            return torch.cat([without[..., :before].expand(*after.shape[:-1], -1), after], -1)

        parts = substeps(chain, drive.command, row, hook)
        accel0, at = torch.as_tensor(drive.accel0).expand(columns), context_at(row, 0)
        actuator0 = accel0
        for e in at_place(chain, "body"):  # the actuator's share is the car's acceleration less the other forces
            first = e.replaced({key: value[..., 0] for key, value in e.values().items()})
            actuator0 = actuator0 - first.advance(accel0, at, first.start(accel0, at))[0]
        a, gained = _actuated(actuator0, parts, chain, late, steps)
        accel = a
        for e in at_place(chain, "body"):
            force = hook(e, a)
            accel = accel + force
            gained = gained + 0.5 * (row.dt[:-1] if row.dt.dim() else row.dt) * (force[..., 1:] + force[..., :-1])
        for e in at_place(chain, "sensor"):
            accel = hook(e, accel)
        zero = torch.zeros(*columns, 1, dtype=torch.float64)
        speed = torch.cat([zero, gained.expand(*columns, -1).cumsum(-1)], -1)
        for e in at_place(chain, "sensor", "speed"):
            speed = hook(e, speed)
        return accel.expand(*columns, steps), speed

    def _effect(self, name: str, values: Values, time: Tensor, first: int) -> Effect:
        """The table's effect with values (column, 1), or (column, time) where it is neutral before a row `first`."""
        coordinates = EFFECTS[name].coordinates
        z = {c.name: values.get(c.name, torch.tensor(self.hypothesis[c.name])) for c in coordinates}
        if name == _UNNAMED:
            pole, frequency = (z[c.name][..., None] for c in coordinates)
            zero = torch.zeros(1, dtype=torch.float64)
            return DrivelineOscillation(frequency, zero, 2 * np.pi * frequency * pole, zero + _FREE_DAMPING)
        effect = table_effect(self.hypothesis, name)
        neutral = {p.name: p.neutral for p in effect.parameters if p.neutral is not None}
        neutral = {k: min(max(x, -_NO_LIMIT), _NO_LIMIT) for k, x in neutral.items()}
        own = {c.parameter: own_value(c, z[c.name])[..., None] for c in coordinates}
        if first and effect.name not in _FILLING and effect.own_onset is None:
            acts = torch.arange(len(time)) >= first
            own |= {k: torch.where(acts, own[k], x) for k, x in neutral.items() if k in own}
        rest = {k: x[..., None] for k, x in effect.values().items() if k not in own}
        return effect.replaced(rest | own)


def _acting(h: Hypothesis) -> list[str]:
    """The hypothesis's effects, and those of its baseline: what is not neutral in the vector."""
    acting = [e for e in h.effects if e != "command_hold"]
    fitted = {c.name for e in acting for c in EFFECTS[e].coordinates}
    for effect in EFFECTS.values():
        names = {c.name for c in effect.coordinates}
        if effect.kind is None and not names & fitted and any(h[n] != NEUTRAL[INDEX[n]] for n in names):
            acting.append(effect.name)
            fitted |= names
    return acting


def _actuated(
    accel0: Tensor, parts: Sequence[Substep], chain: Sequence[Effect], late: Mapping[str, int], steps: int
) -> tuple[Tensor, Tensor]:
    """The actuator's acceleration (column, grid), and the speed gained in each step, (column, grid - 1)."""
    own = [(late[e.name], e.actuator_parameters()) for e in chain]
    cuts = {first for first, given in own if given and 0 < first < steps - 1}
    accels, gains = [accel0[..., None]], []
    for i, j in pairwise([0, *sorted(cuts), steps - 1]):
        given = {key: x[..., -1:] for first, mine in own if first <= i for key, x in mine.items()}
        a, gained = Actuator(**given).over(accels[-1][..., -1], [p.rows(slice(i, j + 1)) for p in parts])
        accels.append(a[..., 1:])
        gains.append(gained)
    return torch.cat(accels, -1), torch.cat(gains, -1)


# the recorder --------------------------------------------------------------------------------------------------------
def recorded(data: DriveData, accel: Tensor, gained: Tensor, values: Values) -> Tensor:
    """Coefficients (column, channel, frame, bin) of a reading and a gained speed, (column, grid) each.

    `values` holds each channel's delay and filter [s], (column,).
    """
    shown = []
    if data.accel is not None:
        a = _low_pass(data, _late(data, accel, values["accel_delay"]), values["accel_filter"])
        shown.append(_read(a, *map(torch.as_tensor, data.aligned_at)) if data.align_s else a)
    if data.speed is not None:
        v = _low_pass(data, _late(data, gained, values["speed_delay"]), values["speed_filter"])
        v = v if data.hold == 1 else _read(v, *map(torch.as_tensor, data.held_at))
        rate, middle = map(torch.as_tensor, data.difference_tables)
        shown.append(((v[..., 2:] - v[..., :-2]) * rate)[..., middle])
    return cast(Tensor, _Transform.apply(torch.stack(shown, -2), data))


def _low_pass(data: DriveData, x: Tensor, time_constant: Tensor) -> Tensor:
    """`DriveData.low_pass`."""
    tau, step = time_constant.clamp_min(1e-4)[..., None], torch.as_tensor(data.gaps[1])
    keep = torch.exp(-step / tau)
    held = tau / step * (1 - keep)
    none = (time_constant < 1e-4)[..., None]
    pole = [torch.where(none, x, y) for x, y in ((0.0, keep), (1.0, 1 - held), (0.0, held - keep))]
    return cast(Tensor, _OnePole.apply(x, *pole, data))


def _late(data: DriveData, x: Tensor, delay: Tensor) -> Tensor:
    """`compiled_plant.read_late`."""
    time, at = torch.as_tensor(data.grid.time), torch.as_tensor(data.time) - delay[..., None]
    index = (torch.searchsorted(time, at.detach().contiguous(), right=True) - 1).clamp(0, len(time) - 2)
    begin = time[index]
    return _read(x, index, ((at - begin) / (time[index + 1] - begin)).clamp(0.0, 1.0))


def _read(x: Tensor, index: Tensor, share: Tensor) -> Tensor:
    """`x` (column, point) linearly between points."""
    index = index.expand(*x.shape[:-1], index.shape[-1])
    low = x.gather(-1, index)
    return low + share * (x.gather(-1, index + 1) - low)


class _OnePole(torch.autograd.Function):
    """`drive_data.filtered`; x (column, row), coefficients (column, gap)."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, keep: Tensor, new: Tensor, old: Tensor, data: DriveData) -> Tensor:
        rows, pole = x.detach().numpy(), [c.detach().numpy() for c in (keep, new, old)]
        y = np.array([filtered(row, data.bounds, data.gaps[0], *own) for row, *own in zip(rows, *pole, strict=True)])
        ctx.x, ctx.y, ctx.pole, ctx.data = rows, y, pole, data
        return torch.as_tensor(y)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        data, on_x, on_pole = ctx.data, [], []
        for g, x, y, *pole in zip(gradient.numpy(), ctx.x, ctx.y, *ctx.pole, strict=True):
            for into, one in zip((on_x, on_pole), _adjoint(g, x, y, data.bounds, data.gaps[0], *pole), strict=True):
                into.append(one)
        return torch.as_tensor(np.array(on_x)), *torch.as_tensor(np.array(on_pole)).movedim(1, 0), None


@njit(cache=True, error_model="numpy")
def _adjoint(
    g: FloatArray,
    x: FloatArray,
    y: FloatArray,
    bounds: IntArray,
    gaps: IntArray,
    keep: FloatArray,
    new: FloatArray,
    old: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Gradients on x (row,) and on the coefficients (keep, new, old; gap) of `drive_data.filtered`, from `g` (row,)."""
    on_x, on_pole = np.zeros(len(x)), np.zeros((3, len(keep)))
    for s in range(len(bounds) - 1):
        costate = 0.0
        for i in range(bounds[s + 1] - 1, bounds[s], -1):
            k = gaps[i]
            costate += g[i]
            on_x[i] += new[k] * costate
            on_x[i - 1] += old[k] * costate
            on_pole[0, k] += costate * y[i - 1]
            on_pole[1, k] += costate * x[i]
            on_pole[2, k] += costate * x[i - 1]
            costate *= keep[k]
        on_x[bounds[s]] += costate + g[bounds[s]]
    return on_x, on_pole


class _Transform(torch.autograd.Function):
    """Rows (..., row) as coefficients (..., frame, bin), a linear map."""

    @staticmethod
    def forward(ctx: Any, rows: Tensor, data: DriveData) -> Tensor:
        ctx.data = data
        flat = data.transform(list(rows.detach().reshape(-1, rows.shape[-1]).numpy()))
        return torch.as_tensor(flat).reshape(*rows.shape[:-1], *flat.shape[1:])

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None]:  # pyright: ignore[reportIncompatibleMethodOverride]
        flat = gradient.reshape(-1, *gradient.shape[-2:]).numpy()
        rows = np.stack([ctx.data.adjoint(x) for x in flat])
        return torch.as_tensor(rows).reshape(*gradient.shape[:-2], -1), None
