"""What an effect does to the car's response, found by simulation rather than declared.

GLVD with the effect answers steps, or rests, at constant speeds; from its answers follow whether the effect is linear,
one-sided, a force of its own, or another gain, and so what a log with one channel can show of it. With acceleration
only, effects that depend on the speed cannot be tested; a force among them would appear as an offset or a gust. With
the speed only, sensor effects are not observable.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable
from functools import lru_cache

import torch
from torch import Tensor

from avtorch.gap.simulator.effect import EFFECTS, Effect, candidate_name
from avtorch.gap.simulator.plant import plant
from avtorch.gap.simulator.simulator_input import SimulatorInput

_FAINT, _HARD = 0.3, 30.0  # steps [m/s²]: within every band and limit, and beyond
_AT_MPS = 12.0
_SPEEDS_MPS = (12.0, 25.0, 1.0)
_LEAST = 1e-9  # m/s²


def _shown(effect: Effect, step: float, speed: float) -> Tensor:
    """Measured acceleration (time,) beyond that at rest, of a step of the command a second after the start."""
    time = 1e3 + 0.02 * torch.arange(400, dtype=torch.float64)
    command = torch.where(time > 1e3 + 1.0, step, 0.0)
    moves, rests = (_accel(effect, time, u, torch.full_like(time, speed)) for u in (command, 0 * command))
    return moves - rests


def _accel(effect: Effect | None, time: Tensor, command: Tensor, speed: Tensor | None = None) -> Tensor:
    """Measured acceleration (..., time) of GLVD with the effect."""
    car = plant([] if effect is None else [effect])
    return car.response(SimulatorInput(time, command, speed)).accel_measured


def is_linear(effect: Effect) -> bool:
    """Whether the response to a step is proportional to it."""
    return torch.allclose(_HARD / _FAINT * _shown(effect, _FAINT, _AT_MPS), _shown(effect, _HARD, _AT_MPS), atol=1e-9)


def is_one_sided(effect: Effect) -> bool:
    """Whether driving and braking differ."""
    return not torch.allclose(_shown(effect, -_HARD, _AT_MPS), -_shown(effect, _HARD, _AT_MPS), rtol=0, atol=1e-9)


def shown_at(effect: Effect) -> float:
    """Speed [m/s] of a picture of the effect: that of a few at which it pushes the car most by itself."""
    time = 0.1 * torch.arange(20, dtype=torch.float64)
    speeds = torch.tensor(_SPEEDS_MPS, dtype=torch.float64)[:, None].expand(-1, len(time))
    return _SPEEDS_MPS[int(_accel(effect, time, 0 * speeds, speeds)[:, -1].abs().argmax())]


def _typical(kind: type[Effect]) -> Effect:
    return kind(**{p.name: float(p.typical()) for p in kind.parameters})


@lru_cache(maxsize=256)
def push_signs(kind: type[Effect]) -> frozenset[int]:
    """Signs of the force that it adds where nothing is commanded; none for an effect without such a force."""
    if kind.random:
        change = _typical(kind).noise(torch.zeros(8, dtype=torch.float64))
        return frozenset({-1, 1} if change is not None and change.force_sd is not None else ())
    time = torch.arange(400, dtype=torch.float64)
    speeds = torch.tensor(_SPEEDS_MPS, dtype=torch.float64)[:, None].expand(-1, len(time))
    draws, first = torch.Generator().manual_seed(0), kind.parameters[0]
    ends = (_typical(kind).replaced({first.name: x}) for x in (first.low, first.high))
    force = torch.cat([_accel(effect.drawn(draws), time, 0 * speeds, speeds).ravel() for effect in ends])
    return frozenset(int(x) for x in torch.where(force.abs() > _LEAST, force, 0.0).sign().unique() if x)


@lru_cache(maxsize=256)
def is_gain(kind: type[Effect]) -> bool:
    """Whether an accelerometer reads it as another K_L."""
    if kind.needs_speed:
        return False
    time = 0.05 * torch.arange(400, dtype=torch.float64)
    own, bare = (_accel(effect, time, 2.0 * torch.sin(time)) for effect in (_typical(kind), None))
    factor = (own @ bare) / (bare @ bare)
    return abs(float(factor) - 1) > 1e-6 and torch.allclose(own, factor * bare, rtol=0, atol=1e-9)


def is_observable(kind: type[Effect], channels: Collection[str]) -> bool:
    """Whether an effect can be tested on a log with these channels."""
    if "accel" not in channels:
        return kind.place != "sensor"
    return "speed" in channels or not (kind.needs_speed or is_gain(kind))


def lookalikes(
    name: str, channels: Collection[str], *, specific_force: bool = False, among: Iterable[type[Effect]] = ()
) -> set[str]:
    """Hypotheses not tested for want of speed, whose force may be the true cause behind a slow force in `name`.

    One such force replaces all slow effects of `name` (an offset, a gust), where its sign allows it. `among`: effects
    beside those registered.
    """
    known = {**EFFECTS, **{e.name: e for e in among}}
    parts = name.split("+") if set(channels) == {"accel"} else []
    slow = {p: push_signs(known[p]) for p in parts if p in known and push_signs(known[p])}
    if not slow:
        return set()
    signs = frozenset.intersection(*slow.values())
    forces = [e for e in known.values() if e.place == "body" and e.needs_speed and push_signs(e) & signs]
    others = [p for p in parts if p not in slow]
    return {candidate_name([*others, e.name]) for e in forces if not (e.gravity and specific_force)}


def not_observable(channels: Collection[str], effects: Iterable[type[Effect]]) -> str | None:
    """One sentence on the `effects` that the log cannot test; None where there are none."""
    hidden = sorted((e for e in effects if not is_observable(e, channels)), key=lambda e: e.name)
    if not hidden:
        return None
    if "accel" not in channels:
        names = ", ".join(e.name for e in hidden)
        return f"Without accel in the log these effects cannot be tested, as speed does not show them: {names}."
    need = ", ".join(e.name for e in hidden if e.reading == "accel" and not is_gain(e))
    said = [f"Without speed in the log these effects cannot be tested and appear as others: {need}."] if need else []
    gains = [e.name for e in hidden if is_gain(e)]
    said += [f"Without speed in the log {name} is equivalent to another K_L and cannot be tested." for name in gains]
    return " ".join(said)
