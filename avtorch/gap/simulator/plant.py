"""A simulator composed of effects: GLVD, and deviations of the car from it.

`plant([DeadTime(0.2), AerodynamicDrag()])` composes them in the chain's order. The result responds to whole drives
(`response`, batched over parameters, differentiable) and drives in `avtorch.simulate` step by step (`step`).
"""

from __future__ import annotations

import copy
import math
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import fields
from os import PathLike
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from avtorch.errors import InputError, quoted
from avtorch.gap.simulator.chain import SimulationState, begin, goes_on, in_order, move, rollout
from avtorch.gap.simulator.effect import Effect, effect_class
from avtorch.gap.simulator.force_table import FREE_FORMS
from avtorch.gap.simulator.parameter import Domain, Parameter
from avtorch.gap.simulator.simulator_input import Response, SimulatorInput
from avtorch.io.opening import parse_toml, place, read_toml
from avtorch.vehicle.arguments import Number, checked, tensor
from avtorch.vehicle.plant import Motion

BASELINE = (
    Parameter("T_L", "s", None, 0.3 * 0.408, 0.3 * 2.452, possible=(0.02, 5.0)),  # log-normal, median 0.3, log sd 0.7
    Parameter("K_L", "-", None, 0.681, 1.469, possible=(0.3, 3.5)),  # log-normal, median 1, log sd 0.3
)
"""Parameters of the baseline, with their priors.

Possible are lags from an electric motor's torque control with its driveline (about 20 ms) to the engine and air brakes
of a laden truck (seconds), and gains as far from 1 as a truck's mass changes between empty and laden (about a factor of
three).
"""


_DOMAINS = {
    "T_L": Domain("T_L", 1e-4, 1e3, "s"),
    "K_L": Domain("K_L", 1e-4, 1e3, neutral=0.0),
    "sigma": Domain("sigma", 0.0, 1e3, "m/s³"),
}
"""Valid values of the baseline's parameters in a text."""


class GapPlant:
    """A plant with `effects`, `T_L` [s], `K_L` [-], jerk noise `sigma` [m/s³]; made by `plant`.

    In the closed loop it is a `Plant`: the acceleration it returns is the *measured* one, so logs and controllers
    receive the sensor's faults, while the car moves by the true one. It keeps the state of the drive (commands in
    transit, position, time since its first step) for as long as it is given the acceleration that it returned, as a
    loop does; any other acceleration starts a new drive in steady state at that value. `reset()` forces a new drive. A
    copy continues independently. Parameters are floats or tensors (scenario,); `seed` is of the random effects. Raises
    `InputError` for an effect given twice.

    Example:
        >>> from avtorch.gap import GapPlant
        >>> car = GapPlant.from_toml("dead_time=0.2")
        >>> slower = car.with_values({"dead_time.delay_s": 0.4, "T_L": 0.5})
        >>> {name: round(float(value), 2) for name, value in slower.values().items()}
        {'T_L': 0.5, 'K_L': 1.0, 'dead_time.delay_s': 0.4}
    """

    def __init__(self, effects: Iterable[Effect], *, T_L: Number, K_L: Number, sigma: Number, seed: int = 0) -> None:
        self.effects = in_order(effects)
        names = [e.name for e in self.effects]
        if len(set(names)) < len(names):
            raise InputError(f"effects: found {', '.join(names)}, needs each at most once")
        for name, value in (("T_L", T_L), ("K_L", K_L), ("sigma", sigma)):
            checked(name, value, above=0.0 if name == "T_L" else None, least=0.0)
        self.T_L, self.K_L, self.sigma, self.seed = T_L, K_L, sigma, seed
        self._past: SimulationState | None = None

    def __repr__(self) -> str:
        return f"plant({list(self.effects)}, T_L={self.T_L}, K_L={self.K_L})"

    def __deepcopy__(self, memo: dict[int, Any]) -> GapPlant:
        return copy.copy(self)  # instances are never modified

    # parameters ----------------------------------------------------------------------------------------------------
    def parameters(self) -> dict[str, Parameter]:
        """The coordinates of a fit: `T_L`, `K_L`, and `effect.parameter` of each effect."""
        own = {p.name: p for p in BASELINE}
        return own | {f"{e.name}.{p.name}": p for e in self.effects for p in e.parameters}

    def values(self) -> dict[str, Tensor]:
        """Their current values; those that are not set (a grade's profile) are left out."""
        own = {"T_L": tensor(self.T_L), "K_L": tensor(self.K_L)}
        return own | {f"{e.name}.{key}": value for e in self.effects for key, value in e.values().items()}

    def with_values(self, values: Mapping[str, Any]) -> GapPlant:
        """The plant with other values, by the names of `parameters`. Raises `InputError` for other names."""
        own: dict[str, dict[str, Any]] = {e.name: {} for e in self.effects}
        base = {"T_L": self.T_L, "K_L": self.K_L}
        for name, value in values.items():
            effect, _, key = name.partition(".")
            if name in base:
                base[name] = value
            elif effect in own and key:
                own[effect][key] = value
            else:
                raise InputError(f"parameters: found {name!r}, needs one of {', '.join(self.parameters())}")
        effects = [e.replaced(own[e.name]) if own[e.name] else e for e in self.effects]
        return GapPlant(effects, **base, sigma=self.sigma, seed=self.seed)

    def prepared(self, *drives: SimulatorInput) -> GapPlant:
        """The plant with the settings that effects take from a drive (mean speed, length of the road), or from several
        parts of one, in order."""
        flat = [_joined([getattr(d, name) for d in drives]) for name in ("speed", "position")]
        time = torch.cat([d.time for d in drives])
        effects = [e.prepared(time, *flat) for e in self.effects]
        return GapPlant(effects, T_L=self.T_L, K_L=self.K_L, sigma=self.sigma, seed=self.seed)

    def report(self) -> dict[str, dict[str, Tensor]]:
        """Parameters by effect, under the answer's names."""
        return {e.name: e.report(tensor(self.T_L)) for e in self.effects}

    # whole drives --------------------------------------------------------------------------------------------------
    def response(
        self,
        drive: SimulatorInput,
        parameters: Mapping[str, Tensor] | None = None,
        *,
        generator: torch.Generator | None = None,
    ) -> Response:
        """The noise-free response to `drive`; with a `generator`, one in which the random effects are drawn.

        `parameters` by the names of `parameters()`, in their own units, each (...), which broadcast with the drive's
        leading dimensions (a vector-valued one has its size on a further, last dimension). Missing ones keep the
        plant's own value. Differentiable in all of them. Speed-dependent effects use the drive's measured speed.
        """
        this = self if parameters is None else self.with_values(parameters)
        return rollout(this.effects, tensor(this.T_L), tensor(this.K_L), drive, generator)

    # one step ------------------------------------------------------------------------------------------------------
    @torch.no_grad()
    def step(self, a: Tensor, v: Tensor, u: Tensor, dt: float, eps: Tensor) -> Motion:
        """See `avtorch.vehicle.plant.Plant.step`; the acceleration that comes back is the measured one."""
        past = self._past
        if past is None or not goes_on(past, a):
            past = begin(self.effects, a, v, u, dt, tensor(self.T_L), tensor(self.K_L), self.seed)
        motion, self._past = move(past, v, u, dt, eps)
        return motion

    def speed_reading(self, a: Tensor, v: Tensor) -> Tensor:
        """The speed [m/s] that the sensor shows after the step that returned `a`; `v`, the car's, in a new drive."""
        return v if self._past is None or not goes_on(self._past, a) else self._past.seen_speed

    def reset(self) -> None:
        """Discard the state of the drive: the next step starts a new one."""
        self._past = None

    # as text -------------------------------------------------------------------------------------------------------
    def to_toml(self) -> str:
        """The plant as TOML; `from_toml` reads it. Raises `InputError` for parameters that are not single numbers."""
        lines = [f"{name} = {_number(name, getattr(self, name))}" for name in ("T_L", "K_L", "sigma")]
        for given in self.effects:
            effect, _ = given.lag_apart()  # T_L is already written there
            lines += ["", f"[{effect.name}]"]
            for f in fields(effect):
                value = getattr(effect, f.name)
                if value is not None:
                    lines.append(f"{f.name} = {_number(f'{effect.name}.{f.name}', value)}")
        return "\n".join(lines) + "\n"

    @classmethod
    def from_toml(cls, text: str, *, effects: Iterable[type[Effect]] = ()) -> GapPlant:
        """The plant from TOML: `T_L`, `K_L`, `sigma`, and a table of parameters for each effect; or from
        `"dead_time=0.2"`.

        `effects`: classes besides the registered ones. Raises `InputError` for unknown names and wrong values.
        """
        return _parsed(text, effects)


def plant(
    effects: Iterable[Effect | type[Effect]] = (),
    *,
    T_L: Number | None = None,
    K_L: Number | None = None,
    sigma: float | None = None,
    baseline: GapPlant | str | PathLike[str] | None = None,
    seed: int = 0,
) -> GapPlant:
    """A plant with `effects` (a class has its typical values) on top of a `baseline`.

    `baseline`: the user's own simulator, as a plant, as a string such as `"dead_time=0.2"` (`"glvd"`: none), or a TOML
    file (a string that ends in `.toml` or names a file); an effect given here replaces the baseline's of that name.
    `T_L` [s], `K_L` [-] and the jerk noise `sigma` [m/s³] default to the baseline's, or 0.3, 1 and 0.1. Raises
    `InputError` for bad values or a missing file.

    Example:
        >>> from avtorch import Leader, simulate
        >>> from avtorch.gap import DeadTime, SensorBias, plant
        >>> car = plant([DeadTime(0.2), SensorBias], T_L=0.4)  # a class stands for its typical values
        >>> run = simulate(Leader.constant(speed=20.0, duration=2.0, dt=0.02), plant=car)
        >>> list(car.report())
        ['dead_time', 'sensor_bias']
    """
    if isinstance(baseline, str) and not _names_a_file(baseline):
        base = GapPlant.from_toml(baseline)
    elif isinstance(baseline, GapPlant) or baseline is None:
        base = baseline or GapPlant((), T_L=0.3, K_L=1.0, sigma=0.1)
    else:
        base = _read(baseline)
    if isinstance(effects, str):
        raise InputError(f"effects: found the text {quoted(effects)}; needs effects; plant(baseline=...) takes a text")
    own = [e() if isinstance(e, type) else e for e in effects]
    for e in own:
        if not isinstance(e, Effect):
            raise InputError(f"effects: found {quoted(repr(e))}, needs effects, such as DeadTime(0.2)")
    kept = [e for e in base.effects if e.name not in {x.name for x in own}]
    for i, e in enumerate(own):
        own[i], implied = e.lag_apart()
        if implied is not None:
            if T_L is not None:
                raise InputError(f"T_L: given beside a {e.name} that sets it; needs one of the two")
            T_L = implied
    return GapPlant(
        [*kept, *own],
        T_L=base.T_L if T_L is None else T_L,
        K_L=base.K_L if K_L is None else K_L,
        sigma=base.sigma if sigma is None else sigma,
        seed=seed,
    )


def _joined(parts: Sequence[Tensor | None]) -> Tensor | None:
    """The parts' first batch elements of (..., time), concatenated, (time,)."""
    flat = [x.reshape(-1, x.shape[-1])[0] for x in parts if x is not None]
    return torch.cat(flat) if flat else None


# as text -------------------------------------------------------------------------------------------------------------
def _parsed(text: str, more: Iterable[type[Effect]] = ()) -> GapPlant:
    """A plant from TOML or a short string; `"glvd"` or nothing is bare GLVD. Raises `InputError` for errors in the
    text.

    A short string is a line of TOML for each of its commas. In it an effect's name sets its first parameter,
    `effect.parameter` any, and an effect without a value has its typical ones.
    """
    if "\n" in text or "[" in text:
        return _of(parse_toml(text, "plant"), more)
    lines = []
    for item in filter(None, map(str.strip, text.split(","))):
        key, equals, value = (x.strip() for x in item.partition("="))
        if equals and "." not in key and key not in _DOMAINS:
            lines.append(f"{key}.{_first(effect_class(key, more))} = {value}")
        elif equals or key.lower() != "glvd":
            lines.append(item if equals else f"{item} = {{}}")
    try:
        tables = parse_toml("\n".join(lines), "plant")
    except InputError:
        raise InputError(
            f"plant: found {quoted(text)}, needs effects, each once, with numbers, as dead_time=0.2"
        ) from None
    return _of(tables, more)


def _names_a_file(text: str) -> bool:
    """Whether a string is a file's name, existing or missing, and not a plant as text."""
    if "\n" in text or text.strip().lower() in ("", "glvd"):
        return False
    try:
        return text.strip().lower().endswith(".toml") or Path(text).is_file()
    except (OSError, ValueError):  # too long for a name, or with a zero byte in it
        return False


def _read(path: str | PathLike[str]) -> GapPlant:
    """A plant from a TOML file of up to 1 MB. Raises `InputError` where it cannot be read."""
    if not os.path.lexists(path):
        raise InputError(f"plant: {place(path)}: no such file; needs a TOML file, or effects such as dead_time=0.2")
    try:
        return _of(read_toml(path), ())
    except InputError as fault:
        raise InputError(f"plant: {fault}") from None


def _number(name: str, value: Any) -> str:
    if isinstance(value, Tensor):
        if value.dim() > 1:
            raise InputError(f"{name}: found shape {tuple(value.shape)}, needs a single value for a text")
        value = value.tolist()
    if isinstance(value, list | tuple):
        return "[" + ", ".join(_number(name, x) for x in value) + "]"
    if isinstance(value, int) and not isinstance(value, bool):
        return repr(value)
    value = float(value)
    if math.isnan(value):
        raise InputError(f"{name}: found nan, needs a number for a text")
    return repr(value)


def _of(tables: Mapping[str, Any], more: Iterable[type[Effect]]) -> GapPlant:
    baseline: dict[str, Any] = {}
    effects = []
    more = (*FREE_FORMS, *more)
    for name, value in tables.items():
        if name in _DOMAINS:
            baseline[name] = _DOMAINS[name].value(name, value)
            continue
        cls = effect_class(name, more)
        table = value if isinstance(value, Mapping) else {_first(cls): value}
        domains = cls.domains()
        # an unknown name is passed on: the effect rejects it and lists the known ones
        given = {key: domains[key].value(f"{name}.{key}", x) if key in domains else x for key, x in table.items()}
        effects.append(cls.of(given))
    return plant(effects, **baseline)


def _first(cls: type[Effect]) -> str:
    """The first parameter under the answer's name."""
    return next(iter(cls().report(tensor(0.3))))
