"""The contract of an effect: something the car does that the simulator does not.

An effect is a frozen dataclass whose fields are its parameters, floats or tensors. It sits at one place in the chain
command → actuator → body → sensor, and its one hook means there:

| place    | hook receives                        | and returns                                               |
|----------|--------------------------------------|-----------------------------------------------------------|
| command  | command [m/s²]                       | command [m/s²]                                            |
| actuator | command [m/s²] as it arrives         | `(gain, lag)`, factors on K_L and T_L                     |
| body     | acceleration of the actuator [m/s²]  | additional acceleration of the car [m/s²]                 |
| sensor   | acceleration of the car [m/s²]       | acceleration shown [m/s²] (`reading`: or speed, [m/s])    |

Without memory the hook is `apply(x, row)`, and one definition serves both a single step of a simulation and a whole
drive: only the shapes differ. With memory it is `start` and `advance`, one row at a time, and `over`, a whole drive.
Without `over` the rows are looped over, which is correct but slow.

That, a name, an equation and parameters with units and priors are all that an effect needs. What it may bring besides
is listed at `Effect`. What can be computed from its response, such as its aliases, is not declared but computed
(`effect_response`).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from difflib import get_close_matches
from typing import Any, ClassVar, Literal, Self, TypeVar

import torch
from torch import Tensor

from avtorch.errors import InputError, quoted
from avtorch.gap.simulator.parameter import Domain, Parameter
from avtorch.vehicle.arguments import Number, broadcast, tensor

Place = Literal["command", "actuator", "body", "sensor"]
PLACES: tuple[Place, ...] = ("command", "actuator", "body", "sensor")
"""Places in the chain, in its order.

Example:
    >>> from avtorch.gap import EFFECTS, PLACES
    >>> {place: sum(effect.place == place for effect in EFFECTS.values()) for place in PLACES}
    {'command': 6, 'actuator': 7, 'body': 7, 'sensor': 5}
"""

_LARGEST = 1e12  # limit for a number in a text without a declared domain
_NAME = 60  # most characters of a name that may be a mistyped effect


@dataclass(frozen=True)
class EffectContext:
    """The input of an effect besides its signal: one row (...) in simulation, whole drives (..., time) otherwise.

    `time` [s] and step `dt` [s] to the next row; `position` [m] since the drive's start; the baseline's `T_L` [s],
    `K_L` [-]; `normal`, standard normal draws for an effect that samples, None where the response is deterministic.

    Example:
        >>> import torch
        >>> from avtorch.gap import AerodynamicDrag, EffectContext
        >>> speed, one = torch.tensor([10.0, 30.0]), torch.tensor(1.0)
        >>> time, dt, T_L = torch.tensor([0.0, 0.1]), 0.1 * one, 0.3 * one
        >>> row = EffectContext(time, dt, measured_speed=speed, travelled=None, T_L=T_L, K_L=one)
        >>> [round(a, 2) for a in AerodynamicDrag(4e-4).apply(0 * speed, row).tolist()]
        [-0.04, -0.36]
    """

    time: Tensor
    dt: Tensor
    measured_speed: Tensor | None
    travelled: Tensor | None
    T_L: Tensor
    K_L: Tensor
    normal: Tensor | None = None

    @property
    def speed(self) -> Tensor:
        """[m/s], not below 0; the measured speed, if the drive is a log. Raises `InputError` if it was not measured."""
        if self.measured_speed is None:
            raise InputError("speed: not in the drive, needed by an effect that depends on it")
        return self.measured_speed.clamp_min(0.0)

    @property
    def position(self) -> Tensor:
        """[m], the integrated measured speed. Raises `InputError` where it was not measured."""
        if self.travelled is None:
            raise InputError("speed: not in the drive, needed by an effect that depends on position")
        return self.travelled


def context_at(row: EffectContext, k: int) -> EffectContext:
    """One row of a whole drive."""

    def pick(x: Tensor | None) -> Any:
        return None if x is None else x if x.dim() == 0 else x[..., 0 if x.shape[-1] == 1 else k]

    parts = (row.time, row.dt, row.measured_speed, row.travelled, row.T_L, row.K_L, row.normal)
    return EffectContext(*(pick(x) for x in parts))


@dataclass(frozen=True)
class NoiseChange:
    """The change that a random effect makes to the noise model; its deterministic response is zero.

    `force_sd` [m/s²] and `force_time` [s]: a coloured (Ornstein-Uhlenbeck) acceleration of the body, in both channels.
    `tail_fraction` of the accelerometer's samples has additional noise of `tail_scale` times its standard deviation.

    The diagnosis finds a user's random effect by it: as the gust or the outliers of the table that it is like. An
    effect to be tested returns one of the two: a force or tails.

    Example:
        >>> import torch
        >>> from avtorch.gap import Gust
        >>> change = Gust(sd_mps2=0.2, time_constant_s=2.2).noise(torch.zeros(100))
        >>> float(change.force_sd), float(change.force_time)
        (0.2, 2.2)
    """

    force_sd: Number | None = None
    force_time: Number | None = None
    tail_fraction: Number | None = None
    tail_scale: Number | None = None


@dataclass(frozen=True)
class Effect:
    """Base of all effects; the module docstring lists the hooks. `order` sorts effects at the same place.

    `reading`: what a sensor's effect acts on. `gravity`: a body force that an accelerometer does not measure (see
    `SimulatorInput.specific_force`). `derived`: what `report` names in place of coordinates that are not reported,
    with typical and possible ranges. `words`: what it does to the car, as a clause with its parameters in braces.
    `shift`: the parameter [s], if there is one, by which it delays commands and does nothing else. `settings`: valid
    values in a text for fields that are not parameters; a field without a domain takes any single finite number.

    `own_onset`: the parameter [s] that is its onset; no other onset is tried. `of_the_drive`: its parameters belong to
    a drive and not to the car. `memory`, `random`: whether it has `advance` and `noise`, which need not be said.

    Example:
        >>> import torch
        >>> from dataclasses import dataclass
        >>> from avtorch.gap import Effect, Parameter, plant
        >>> @dataclass(frozen=True)
        ... class Trailer(Effect):
        ...     mass_ratio: float = 0.4
        ...     name, place, meaning, equation = "trailer", "actuator", "an unknown trailer", "K_L / (1 + m), pulling"
        ...     parameters = (Parameter("mass_ratio", "-", neutral=0.0, low=0.1, high=0.8),)
        ...     def apply(self, x, row):
        ...         return torch.where(x > 0, 1 / (1 + torch.as_tensor(self.mass_ratio)), 1.0), 1.0  # on K_L and T_L
        >>> sorted(plant([Trailer(0.3)]).parameters())
        ['K_L', 'T_L', 'trailer.mass_ratio']
    """

    name: ClassVar[str]
    place: ClassVar[Place]
    meaning: ClassVar[str]
    equation: ClassVar[str]
    words: ClassVar[str] = ""
    parameters: ClassVar[tuple[Parameter, ...]]
    settings: ClassVar[tuple[Domain, ...]] = ()
    order: ClassVar[int] = 0
    reading: ClassVar[Literal["accel", "speed"]] = "accel"
    needs_speed: ClassVar[bool] = False
    gravity: ClassVar[bool] = False
    derived: ClassVar[tuple[Parameter, ...]] = ()
    shift: ClassVar[str | None] = None
    own_onset: ClassVar[str | None] = None
    of_the_drive: ClassVar[bool] = False
    memory: ClassVar[bool] = False
    random: ClassVar[bool] = False

    def __init_subclass__(cls) -> None:
        cls.memory = cls.memory or cls.advance is not Effect.advance
        cls.random = cls.random or cls.noise is not Effect.noise

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
        """Fields of `Actuator` that it sets: `tau` [s], `jerk` [m/s³], `fall` [-]."""
        return {}

    def accel_limits(self) -> tuple[float, float] | None:
        """Lowest (negative) and highest acceleration [m/s²] that the car can reach with it, -inf or inf where there is
        no limit; None: neither."""
        return None

    @classmethod
    def in_words(cls, values: Mapping[str, float]) -> str:
        """What it does to the car, as a clause, at `values` of its parameters under the answer's names: its `words`.

        Empty for an effect that is called by its name.
        """
        return cls.words.format_map(values)

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
        return {p.name: tensor(getattr(self, p.name)) for p in self.parameters if p.reported}

    def values(self) -> dict[str, Tensor]:
        """The fit's coordinates by name, without those that are None."""
        named = {p.name: getattr(self, p.name) for p in self.parameters}
        return {name: tensor(value) for name, value in named.items() if value is not None}

    def replaced(self, values: Mapping[str, Any]) -> Self:
        """The effect with other values. Raises `InputError` for a name that is no field of the effect."""
        self._check_names(values)
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
        cls._check_names(values)
        return cls(**values)

    @classmethod
    def _check_names(cls, values: Mapping[str, Any]) -> None:
        known = {f.name for f in fields(cls)}
        for name in values:
            if name not in known:
                raise InputError(f"{cls.name}: found {quoted(name)}, needs one of {', '.join(sorted(known))}")


def _stacked(rows: list[Tensor]) -> Tensor:
    return torch.stack(broadcast(*rows), -1)


EFFECTS: dict[str, type[Effect]] = {}
"""Registered effects by name.

Example:
    >>> from avtorch.gap import EFFECTS
    >>> len(EFFECTS), [name for name, effect in EFFECTS.items() if effect.place == "sensor"]
    (25, ['outliers', 'sensor_bias', 'sensor_lag', 'sensor_scale', 'speed_lag'])
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
    """The effect called `name`, among those registered and `more`. Raises `InputError` if there is none."""
    known = {**EFFECTS, **{cls.name: cls for cls in more}}
    if name not in known:
        close = get_close_matches(name[:_NAME], known, n=1)
        need = f"an effect's name; perhaps {close[0]}" if close else f"one of {', '.join(sorted(known))}"
        raise InputError(f"effect: found {quoted(name)}, needs {need}")
    return known[name]


def candidate_name(names: str | Iterable[str]) -> str:
    """The canonical name of a hypothesis: its effects in alphabetical order, joined by `+`."""
    return "+".join(sorted(names.split("+") if isinstance(names, str) else names))


def chosen_effects(effects: Sequence[str | type[Effect]] | None) -> list[type[Effect]]:
    """The classes of `effects` that a caller asks for, by name or class; where it is None all registered
    ones in alphabetical order.

    Raises `InputError` for a single name in place of a list, for anything that is no effect, and for one given twice.
    """
    if effects is None:
        return [EFFECTS[name] for name in sorted(EFFECTS)]
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


def delay_effect() -> type[Effect]:
    """The effect that serves as a bare delay: the first one registered that does nothing else."""
    return next(cls for cls in EFFECTS.values() if cls.shift is not None)


def delay_key() -> str:
    """The key of that delay [s] among a plant's parameters."""
    kind = delay_effect()
    return f"{kind.name}.{kind.shift}"


def cause_words(name: str, values: Mapping[str, float]) -> str:
    """What the effect called `name` does to the car, at `values` of its parameters under the answer's names.

    Its general meaning where a value is not known; empty where it brings no sentence or is not registered.

    Example:
        >>> from avtorch.gap.simulator.effect import cause_words
        >>> cause_words("brake_throttle_asymmetry", {"brake_gain_ratio": 0.7, "brake_lag_ratio": 1.0})
        'the brake is weaker than the throttle'
        >>> cause_words("dead_time", {}), cause_words("trailer", {"mass_ratio": 0.4})
        ('the command acts after a delay', '')
    """
    kind = EFFECTS.get(name)
    if kind is None:
        return ""
    try:
        return kind.in_words({key: x for key, x in values.items() if not math.isnan(x)})
    except KeyError:  # a value that the words need is not known
        return kind.meaning


def named_cause(name: str, values: Mapping[str, float], behind: str = "") -> str:
    """The cause in words, in brackets its name and what is said `behind` it; the name alone where there are no words.

    Example:
        >>> from avtorch.gap.simulator.effect import named_cause
        >>> named_cause("dead_time", {"delay_s": 0.21}, "62 % of the gap")
        'commands act 0.21 s late (dead_time, 62 % of the gap)'
        >>> named_cause("trailer", {}, "62 % of the gap"), named_cause("trailer", {})
        ('trailer (62 % of the gap)', 'trailer')
    """
    words = cause_words(name, values)
    inside = ", ".join(x for x in (name if words else "", behind) if x)
    return f"{words or name} ({inside})" if inside else name
