"""Effects that a log with one channel cannot distinguish, reported as an alias set.

With the acceleration only, a sensor offset is equivalent to a constant force on the car, a sensor filter to a second
pole of the actuator, and the sensor's scale to another `K_L`. Effects that depend on the speed cannot be tested; a
force among them would appear as an offset or a gust. With the speed only, sensor effects are not observable. With both
channels there are no exact aliases.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence

from avtorch.gap.answer.verdict import candidate_name
from avtorch.gap.simulator.effect import EFFECTS, Effect
from avtorch.gap.simulator.observability import is_observable

Values = Mapping[str, float]
Kinds = Iterable[type[Effect]]


def exact_aliases(name: str, channels: Collection[str], values: Values | None = None, among: Kinds = ()) -> set[str]:
    """Hypotheses with the same response as `name` to every command in these `channels`, including `name` itself.

    `values`: fitted parameters, by the plant's keys; a resistance is equivalent only to an offset below 0, and a
    sensor's lag only to an actuator that does not overshoot. Without them every alias counts. `among`: effects beside
    those registered.
    """
    known = _known(among)
    parts = name.split("+")
    same = {name}
    if set(channels) != {"accel"}:
        return same
    for one in parts:
        others = [p for p in parts if p != one]
        for other in _instead(one, others, values, known):
            if other not in parts:
                same.add(candidate_name([*others, other]))
    return same


def _known(among: Kinds) -> dict[str, type[Effect]]:
    return {**EFFECTS, **{e.name: e for e in among}}


def _instead(
    one: str, others: Sequence[str], values: Values | None, known: Mapping[str, type[Effect]]
) -> Iterable[str]:
    """Effects equivalent to `one` in combination with the `others`."""
    kind = known.get(one)
    if kind is None or kind.alias is None:
        return ()
    same = [e for e in known.values() if e.alias == kind.alias]
    if kind.alias == "offset":
        constant = kind.constant_accel(_own(one, values))
        return [e.name for e in same if constant is None or e.force_sign * constant >= 0]
    if kind.alias == "pole":
        linear = all(p in known and (known[p].commutes or known[p].place == "command") for p in others)
        own = _own(one, values)
        return [e.name for e in same] if linear and (own is None or kind.aliased(own)) else ()
    return ()  # another K_L is no hypothesis: it is not observable at all


def _own(name: str, values: Values | None) -> Values | None:
    """`values` of the effect by its own parameters' names, with the plant's `T_L` and `K_L`."""
    if values is None:
        return None
    own = {key.removeprefix(f"{name}."): x for key, x in values.items() if key.startswith(f"{name}.")}
    return own | {key: values[key] for key in ("T_L", "K_L") if key in values}


def lookalikes(
    name: str,
    channels: Collection[str],
    values: Values | None = None,
    *,
    specific_force: bool = False,
    among: Kinds = (),
) -> set[str]:
    """Hypotheses not tested for want of speed, whose force may be the true cause behind a slow force in `name`.

    One such force replaces all slow effects of `name` (an offset, a gust), where its sign allows it.
    """
    parts, known = name.split("+"), _known(among)
    slow = [known[p] for p in parts if p in known and known[p].slow_force]
    if set(channels) != {"accel"} or not slow:
        return set()
    constants = (e.constant_accel(_own(e.name, values)) for e in slow)
    offset = next((x for x in constants if x is not None), None)
    others = [p for p in parts if p not in {e.name for e in slow}]
    forces = [e for e in known.values() if e.place == "body" and e.needs_speed]
    return {
        candidate_name([*others, e.name])
        for e in forces
        if not (e.gravity and specific_force) and (offset is None or e.force_sign * offset >= 0)
    }


def in_place_of(
    name: str,
    others: Sequence[str],
    channels: Collection[str],
    values: Values | None = None,
    *,
    specific_force: bool = False,
    among: Kinds = (),
) -> set[str]:
    """Effects that may be the cause in the place of `name`, beside `others`: exact aliases and forces not tested.

    `values`: the fitted parameters of `name`, by the plant's keys.
    """
    if set(channels) != {"accel"}:
        return set()
    alike = lookalikes(name, channels, values, specific_force=specific_force, among=among)
    return {*_instead(name, others, values, _known(among)), *alike} - {name, *others}


def note(channels: Collection[str], effects: Iterable[type[Effect]]) -> str | None:
    """One sentence on the `effects` that the log cannot test; None where there are none."""
    hidden = sorted((e for e in effects if not is_observable(e, channels)), key=lambda e: e.name)
    if not hidden:
        return None
    if "accel" not in channels:
        names = ", ".join(e.name for e in hidden)
        return f"Without accel in the log these effects cannot be tested, as speed does not show them: {names}."
    sentences = []
    need = [e.name for e in hidden if e.alias != "K_L"]
    if need:
        sentences.append(
            f"Without speed in the log these effects cannot be tested and appear as others: {', '.join(need)}."
        )  # fmt: skip
    sentences += [
        f"Without speed in the log {e.name} is equivalent to another K_L and cannot be tested."
        for e in hidden
        if e.alias == "K_L"
    ]
    return " ".join(sentences)
