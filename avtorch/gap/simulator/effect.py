"""The contract of an effect: something the car does that the simulator does not.

An effect is a frozen dataclass whose fields are its parameters, floats or tensors. It sits at one place in the chain
command → actuator → body → sensor, and its one hook means there:

| place    | hook receives                        | and returns                                               |
|----------|--------------------------------------|-----------------------------------------------------------|
| command  | command [m/s²]                       | command [m/s²]                                            |
| actuator | command [m/s²] as it arrives         | `(gain, lag)`, factors on K_L and T_L                     |
| body     | acceleration of the actuator [m/s²]  | additional acceleration of the car [m/s²]                 |
| sensor   | acceleration of the car [m/s²]       | acceleration shown [m/s²]                                 |

Without memory the hook is `apply(x, row)`, and one definition serves both a single step of a simulation and a whole
drive: only the shapes differ. With memory (`memory = True`) it is `start` and `advance`, one row at a time, and `over`,
a whole drive. Without `over` the rows are looped over, which is correct but slow.

An effect also declares what the rest of the package needs to know of it, so that no file outside `effects/` names one.
The defaults suit an ordinary effect:

| used by                 | declared by                                            | default                         |
|-------------------------|--------------------------------------------------------|---------------------------------|
| search: initial values  | `starts`                                               | typical sizes                   |
| search: onset           | `own_onset`; `values_after_onset`                      | any row is tried                |
| search: randomness      | `noise`; `noise_parameters`, `in_noise`                | a law like one of the table     |
| experiments             | `integrated.Integrated`                                | nothing is unknown along a road |
| actuator                | `actuator_parameters`                                  | first order, no rate limit      |
| aliases: which          | `alias`, `aliased`, `constant_accel`, `force_sign`     | no equivalent effect            |
| aliases: in combination | `slow_force`, `commutes`                               | its force follows the command   |
| cross-validation        | `of_the_drive`                                         | parameters are the car's        |
| linearisation           | `linear`, `one_sided`                                  | proportional to the command     |
| delay                   | `shift`, `role`                                        | none                            |
| answers in words        | `in_words`                                             | its name                        |
| exports, plots          | `accel_limits`, `export_loss`, `pictured`                | not exported; plotted at 12 m/s |
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields, replace
from difflib import get_close_matches
from types import MappingProxyType
from typing import Any, ClassVar, Literal, Self, TypeVar

import torch
from torch import Tensor

from avtorch.errors import InputError, quoted
from avtorch.gap.simulator.domain import Domain
from avtorch.gap.simulator.effect_context import EffectContext, context_at
from avtorch.gap.simulator.parameter import Parameter
from avtorch.vehicle.arguments import Number, broadcast, tensor

Place = Literal["command", "actuator", "body", "sensor"]
Alias = Literal["offset", "pole", "K_L"]
"""The effect's equivalent in the measured acceleration: a constant, one more real pole, or a factor."""
PLACES: tuple[Place, ...] = ("command", "actuator", "body", "sensor")
"""Places in the chain, in its order.

Example:
    >>> from avtorch.gap import EFFECTS, PLACES
    >>> {place: sum(effect.place == place for effect in EFFECTS.values()) for place in PLACES}
    {'command': 5, 'actuator': 7, 'body': 6, 'sensor': 4}
"""

V = TypeVar("V")


def fixed(**values: V) -> Mapping[str, V]:
    """`values` by name, read-only, for a class attribute that cannot be changed by mistake."""
    return MappingProxyType(values)


_LARGEST = 1e12  # limit for a number in a text without a declared domain
_NAME = 60  # most characters of a name that may be a mistyped effect


@dataclass(frozen=True)
class NoiseChange:
    """The change that a random effect makes to the noise model; its deterministic response is zero.

    `force_sd` [m/s²] and `force_time` [s]: a coloured (Ornstein-Uhlenbeck) acceleration of the body, in both channels.
    `tail_fraction` of the accelerometer's samples has additional noise of `tail_scale` times its standard deviation.
    `command_variance` (..., time) [(m/s²)²]: mean square difference between the command acting in a row and the one
    logged there, independent from row to row.

    The diagnosis finds a user's random effect by it: as the gust or the outliers of the table that it is like. An
    effect to be tested returns one of the two: a force or tails.

    Example:
        >>> import torch
        >>> from avtorch.gap import Gust
        >>> change = Gust(sd_mps2=0.2, time_constant_s=2.2).noise(torch.zeros(100))
        >>> float(change.force_sd), float(change.force_time), change.command_variance
        (0.2, 2.2, None)
    """

    force_sd: Number | None = None
    force_time: Number | None = None
    tail_fraction: Number | None = None
    tail_scale: Number | None = None
    command_variance: Tensor | None = None


@dataclass(frozen=True)
class Effect:
    """Base of all effects; the module docstring lists the hooks. `order` sorts effects at the same place.

    `gravity`: a body force that an accelerometer does not measure (see `SimulatorInput.specific_force`). `derived`:
    what `report` names in place of coordinates that are not reported, with typical and possible ranges. `shift`: the
    parameter [s], if there is one, by which it delays commands and does nothing else. `settings`: valid values in a
    text for fields that are not parameters; a field without a domain takes any single finite number.

    Search. `starts`: initial values of some parameters, tried in all combinations and then one at a time. `own_onset`:
    the parameter [s] that is its onset; no other onset is tried. `of_the_drive`: its parameters belong to a drive and
    not to the car, so it is no placebo in a cross-validation.

    Randomness. `noise_parameters`: its parameters by their names in `NoiseChange` (`force_sd` and `force_time`,
    `tail_fraction` and `tail_scale`), or `loss`.

    Aliases, where the log has no speed. `alias`: effects with the same value respond alike, as far as `aliased` and
    `force_sign` allow; one with `"K_L"` is not observable there. `force_sign`: the only possible sign of its force, 0:
    either. `slow_force`: its force does not follow the command, so a speed-dependent force may be mistaken for it.
    `commutes`: its position among two poles in series makes no difference.

    Elsewhere. `linear` False: the step response is not proportional to the step. `one_sided`: it differs between
    driving and braking. `role`: `"delay"` for the effect that serves as a bare delay wherever one is needed.
    `export_loss`: what an export to other tools cannot express about this effect. `pictured`: speed [m/s] at which it
    is visible.

    Example:
        >>> from dataclasses import dataclass
        >>> from avtorch.gap import Effect, Parameter, plant
        >>> @dataclass(frozen=True)
        ... class Trailer(Effect):
        ...     mass_ratio: float = 0.4
        ...     name, place, meaning, equation = "trailer", "actuator", "an unknown trailer", "K_L / (1 + m)"
        ...     parameters = (Parameter("mass_ratio", "-", neutral=0.0, low=0.1, high=0.8),)
        ...     def apply(self, x, row):
        ...         return 1 / (1 + self.mass_ratio), 1.0  # factors on K_L and T_L
        >>> sorted(plant([Trailer(0.3)]).parameters())
        ['K_L', 'T_L', 'trailer.mass_ratio']
    """

    name: ClassVar[str]
    place: ClassVar[Place]
    meaning: ClassVar[str]
    equation: ClassVar[str]
    parameters: ClassVar[tuple[Parameter, ...]]
    settings: ClassVar[tuple[Domain, ...]] = ()
    order: ClassVar[int] = 0
    memory: ClassVar[bool] = False
    random: ClassVar[bool] = False
    needs_speed: ClassVar[bool] = False
    gravity: ClassVar[bool] = False
    derived: ClassVar[tuple[Parameter, ...]] = ()
    shift: ClassVar[str | None] = None

    starts: ClassVar[Mapping[str, tuple[float, ...]]] = fixed()
    own_onset: ClassVar[str | None] = None
    of_the_drive: ClassVar[bool] = False
    noise_parameters: ClassVar[Mapping[str, str]] = fixed()
    alias: ClassVar[Alias | None] = None
    force_sign: ClassVar[Literal[-1, 0, 1]] = 0
    slow_force: ClassVar[bool] = False
    commutes: ClassVar[bool] = False
    linear: ClassVar[bool] = True
    one_sided: ClassVar[bool] = False
    role: ClassVar[Literal["delay"] | None] = None
    export_loss: ClassVar[str] = ""
    pictured: ClassVar[float] = 12.0

    # the hook ------------------------------------------------------------------------------------------------------
    def apply(self, x: Tensor, row: EffectContext) -> Any:
        """Output of an effect without memory."""
        raise NotImplementedError(f"{type(self).__name__} has neither apply nor advance")

    def start(self, x: Tensor, row: EffectContext) -> Any:
        """State before the first row, in steady state at input `x` (...)."""
        return None

    def advance(self, x: Tensor, row: EffectContext, state: Any) -> tuple[Any, Any]:
        """Output of this row and the state after it."""
        return self.apply(x, row), state

    def over(self, x: Tensor, row: EffectContext) -> Any:
        """Output over whole drives, `x` (..., time)."""
        if not self.memory:
            return self.apply(x, row)
        state = self.start(x[..., 0], context_at(row, 0))
        outputs: list[Tensor | tuple[Number, ...]] = []
        for k in range(x.shape[-1]):
            y, state = self.advance(x[..., k], context_at(row, k), state)
            outputs.append(y)
        factors = [y for y in outputs if isinstance(y, tuple)]
        if factors:
            return tuple(_stacked([tensor(y) for y in of_rows]) for of_rows in zip(*factors, strict=True))
        return _stacked([y for y in outputs if isinstance(y, Tensor)])

    # around it -----------------------------------------------------------------------------------------------------
    def noise(self, u: Tensor) -> NoiseChange | None:
        """Change of the noise model under commands `u` (..., time), by which a random effect is found.

        None for a deterministic effect.
        """
        return None

    def in_noise(self, accel_sd: float) -> Self:
        """This effect with its settings taken from a log's white accelerometer noise `accel_sd` [m/s²]."""
        return self

    def actuator_parameters(self) -> Mapping[str, Tensor]:
        """Fields of `Actuator` that it sets: `tau` [s], `jerk` [m/s³]."""
        return {}

    def accel_limits(self) -> tuple[float, float] | None:
        """Lowest (negative) and highest acceleration [m/s²] that the car can reach with it, -inf or inf where there is
        no limit; None: neither."""
        return None

    def values_after_onset(self) -> Mapping[str, float]:
        """Parameter values at which any change during a drive is long past."""
        return {}

    @classmethod
    def aliased(cls, values: Mapping[str, float]) -> bool:
        """Whether it responds as its `alias` states, at these `values` of its parameters and of `T_L` [s]."""
        return True

    @classmethod
    def constant_accel(cls, values: Mapping[str, float] | None) -> float | None:
        """The constant [m/s²] that it adds to the measured acceleration, at `values` of its parameters (None: unknown).

        Where they are unknown, any number of the only possible sign. None where it is not known to be constant.
        """
        return None

    @classmethod
    def in_words(cls, values: Mapping[str, float]) -> str:
        """What it does to the car, as a clause, at `values` of its parameters under the answer's names."""
        return cls.meaning

    @classmethod
    def alike(cls, values: Mapping[str, float]) -> tuple[str, ...]:
        """Names of effects that no log tells from it, at `values` of its parameters under the answer's names."""
        return ()

    @classmethod
    def brings_words(cls) -> bool:
        """Whether it has a clause of its own; else it is called by its name."""
        return cls.in_words.__func__ is not Effect.in_words.__func__

    def coordinates(self) -> tuple[Parameter, ...]:
        """The parameters of a fit: `parameters`, unless settings of this instance affect them."""
        return self.parameters

    def prepared(self, time: Tensor, speed: Tensor | None, position: Tensor | None) -> Self:
        """This effect with the settings taken from a drive (mean speed, span), each (time,)."""
        return self

    def drawn(self, generator: torch.Generator | None) -> Self:
        """This effect with anything that is random once per drive drawn."""
        return self

    def lag_apart(self) -> tuple[Self, Tensor | None]:
        """This effect without its own value of the plant's `T_L` [s], and that `T_L`; None where it has none."""
        return self, None

    def report(self, T_L: Tensor) -> dict[str, Tensor]:
        """The parameters under the answer's names, given the plant's lag."""
        return {p.name: tensor(getattr(self, p.name)) for p in self.coordinates() if p.reported}

    def values(self) -> dict[str, Tensor]:
        """The fit's coordinates by name, without those that are None."""
        named = {p.name: getattr(self, p.name) for p in self.coordinates()}
        return {name: tensor(value) for name, value in named.items() if value is not None}

    def replaced(self, values: Mapping[str, Any]) -> Self:
        """The effect with other values. Raises `InputError` for a name that is no field of the effect."""
        known = {f.name for f in fields(self)}
        for name in values:
            if name not in known:
                raise InputError(f"{self.name}: found {quoted(name)}, needs one of {', '.join(sorted(known))}")
        return replace(self, **values)

    @classmethod
    def neutral(cls) -> Self:
        """The effect at its neutral values: the plant is then GLVD to machine precision."""
        return cls(**{p.name: p.neutral for p in cls.parameters if p.neutral is not None})

    @classmethod
    def domains(cls) -> dict[str, Domain]:
        """Valid values, in a text, of each field and of each other name that `of` takes."""
        anything = {f.name: Domain(f.name, -_LARGEST, _LARGEST) for f in fields(cls)}
        return anything | {p.name: Domain.of(p) for p in cls.parameters} | {s.name: s for s in cls.settings}

    @classmethod
    def of(cls, values: Mapping[str, Any]) -> Self:
        """The effect from parameters under the answer's names. Raises `InputError` for other names."""
        known = {f.name for f in fields(cls)}
        for name in values:
            if name not in known:
                raise InputError(f"{cls.name}: found {quoted(name)}, needs one of {', '.join(sorted(known))}")
        return cls(**values)


def _stacked(rows: list[Tensor]) -> Tensor:
    return torch.stack(broadcast(*rows), -1)


EFFECTS: dict[str, type[Effect]] = {}
"""Registered effects by name.

Example:
    >>> from avtorch.gap import EFFECTS
    >>> len(EFFECTS), [name for name, effect in EFFECTS.items() if effect.place == "sensor"]
    (22, ['outliers', 'sensor_bias', 'sensor_lag', 'sensor_scale'])
"""

E = TypeVar("E", bound=type[Effect])


def register(cls: E) -> E:
    """Register an effect by its name (for strings, TOML files and searches). Raises `InputError` if the name is taken.

    Example:
        >>> from avtorch import InputError
        >>> from avtorch.gap import DeadTime, register
        >>> class Mine(DeadTime):
        ...     pass  # its name is still `dead_time`
        >>> try:
        ...     register(Mine)
        ... except InputError as error:
        ...     print(str(error).split(":")[0])
        dead_time
    """
    if cls.place not in PLACES:
        raise InputError(f"{cls.name}: found place {cls.place!r}, needs one of {', '.join(PLACES)}")
    if EFFECTS.get(cls.name, cls).__qualname__ != cls.__qualname__:
        raise InputError(f"{cls.name}: another effect has this name")
    EFFECTS[cls.name] = cls
    return cls


def effect_class(name: str, more: Iterable[type[Effect]] = ()) -> type[Effect]:
    """The effect called `name`, among those registered and `more`. Raises `InputError` if there is none.

    Example:
        >>> from avtorch.gap import effect_class
        >>> effect_class("dead_time")(delay_s=0.2)
        DeadTime(delay_s=0.2)
    """
    known = {**EFFECTS, **{cls.name: cls for cls in more}}
    if name not in known:
        close = get_close_matches(name[:_NAME], known, n=1)
        need = f"an effect's name; perhaps {close[0]}" if close else f"one of {', '.join(sorted(known))}"
        raise InputError(f"effect: found {quoted(name)}, needs {need}")
    return known[name]


def delay_effect() -> type[Effect]:
    """The effect that serves as a bare delay: the first one registered with that role."""
    return next(cls for cls in EFFECTS.values() if cls.role == "delay")


def delay_key() -> str:
    """The key of that delay [s] among a plant's parameters."""
    kind = delay_effect()
    return f"{kind.name}.{kind.shift}"
