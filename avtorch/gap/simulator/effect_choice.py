"""The effects that a caller asks for, by name or class."""

from __future__ import annotations

from collections.abc import Sequence

from avtorch.errors import InputError, quoted
from avtorch.gap.simulator.effect import EFFECTS, Effect, effect_class


def chosen_effects(effects: Sequence[str | type[Effect]] | None) -> list[type[Effect]]:
    """The classes of `effects`, all registered ones where it is None.

    Raises `InputError` for a single name in place of a list, for anything that is no effect, and for one given twice.
    """
    if effects is None:
        return list(EFFECTS.values())
    if isinstance(effects, str):
        raise InputError(f"effects: found {quoted(effects)}, needs a list of names or classes")
    kinds: list[type[Effect]] = []
    given: list[object] = list(effects)
    for effect in given:
        kind = effect_class(effect) if isinstance(effect, str) else effect
        if not (isinstance(kind, type) and issubclass(kind, Effect)):
            raise InputError(f"effects: found {quoted(repr(effect))}, needs names or classes of effects")
        if kind in kinds:
            raise InputError(f"effects: found {kind.name} twice, needs each effect once")
        kinds.append(kind)
    return kinds
