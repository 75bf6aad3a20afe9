"""The chain's order, and the actuator's input from the effects upstream of it."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

from torch import Tensor

from avtorch.gap.simulator.actuator import Actuator, Substep
from avtorch.gap.simulator.effect import PLACES, Effect, Place
from avtorch.gap.simulator.effect_context import EffectContext

Hook = Callable[[Effect, Tensor], Any]
"""Runs an effect with memory: `hook(effect, x) -> output`, for one row or a whole drive."""


def in_order(effects: Iterable[Effect]) -> tuple[Effect, ...]:
    """Effects by place, then by their own order."""
    return tuple(sorted(effects, key=lambda e: (PLACES.index(e.place), e.order, e.name)))


def at_place(effects: Iterable[Effect], place: Place, reading: str = "accel") -> list[Effect]:
    """The effects at that place, in order; of a sensor's those on that reading."""
    return [e for e in effects if e.place == place and e.reading == reading]


def substeps(effects: Iterable[Effect], u: Tensor, row: EffectContext, hook: Hook) -> list[Substep]:
    """Targets, lags and lengths of each step's parts: the command through its effects, then gains and lags."""
    late, early, first = u, None, None
    for e in at_place(effects, "command"):
        out = hook(e, late)
        if isinstance(out, tuple):
            early, late, first = out
        else:  # what follows a delay has no memory
            early = None if early is None else hook(e, early)
            late = out
    pieces = [(late, row.dt)]
    if early is not None and first is not None:
        pieces = [(early, first), (late, row.dt - first)]
    once = {e.name: hook(e, late) for e in at_place(effects, "actuator") if e.memory}
    parts = []
    for command, length in pieces:
        gain, lag = row.K_L, row.T_L
        for e in at_place(effects, "actuator"):
            more, slower = once[e.name] if e.memory else e.apply(command, row)
            gain, lag = gain * more, lag * slower
        parts.append(Substep(gain * command, lag, length))
    return parts


def actuator_of(effects: Iterable[Effect]) -> Actuator:
    """The actuator: first order, unless effects change it."""
    given: dict[str, Tensor] = {}
    for e in effects:
        given |= e.actuator_parameters()
    return Actuator(**given)
