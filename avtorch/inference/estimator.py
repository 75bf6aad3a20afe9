"""What all estimators in a stream of windows share: a belief per vehicle, what one remembers beside it, and resume."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor

from avtorch.errors import InputError
from avtorch.inference.belief import Belief, Summary
from avtorch.inference.device import Device, checked_device
from avtorch.inference.form import Form, Rows, WindowLikelihood
from avtorch.inference.priors import Joint, Prior, default_actuation_prior


class Estimator(ABC):
    """Takes the windows of many vehicles one after another and keeps a belief about them.

    A window that is not excited leaves the belief of its vehicle as it was. Memory does not grow with the windows.

    Args:
        names: parameters of the belief, ``T_L`` and ``K_L`` first.
        noise_prior: of the others.
        actuation_prior: of ``(T_L [s], K_L [-])`` before the first excited window.
        kept: draws per vehicle that a belief carries.
        device: where belief and memory are, and what `take` is given has to be.

    Raises `InputError` for fewer than two draws or one vehicle, or a device that this machine lacks.
    """

    def __init__(
        self,
        names: tuple[str, ...],
        noise_prior: Prior,
        *,
        vehicles: int = 1,
        actuation_prior: Prior | None = None,
        kept: int = 1000,
        seed: int = 0,
        device: Device = "cpu",
    ) -> None:
        if kept < 2 or vehicles < 1:
            raise InputError(f"kept, vehicles: found {kept}, {vehicles}, need 2 or more draws and 1 or more vehicles")
        self.kept, self.vehicles, self.device = kept, vehicles, checked_device(device)
        actuation = default_actuation_prior() if actuation_prior is None else actuation_prior
        self.first_prior = Joint(actuation, noise_prior).to(self.device)
        self.generator = torch.Generator(device=self.device).manual_seed(seed)
        self.belief = Belief.of_prior(names, self.first_prior, kept, vehicles, self.generator)
        self._memory: dict[str, Tensor] = {}  # one entry a vehicle

    @abstractmethod
    def take(self, rows: Rows, likelihood: WindowLikelihood) -> Belief:
        """Take in one window: its rows, each column ``(vehicle, time)``, and what the form makes of them."""

    def _updated(self, excited: Tensor, learn: Callable[[Tensor], tuple[Summary, Tensor]]) -> Belief:
        """The belief after a window, of which ``learn`` gives what it makes of the excited vehicles, named by an index:
        their summary, and where it may be used, ``(vehicle,)`` bool. The others keep their belief."""
        index = excited.nonzero().squeeze(-1)
        self.belief = self.belief.updated(excited, index, *learn(index)) if len(index) else self.belief.unused(excited)
        return self.belief

    def _remember(self, index: Tensor, **found: Tensor) -> None:
        """Keep what was found of the vehicles ``index``."""
        self._memory |= {name: self._memory[name].index_put((index,), value) for name, value in found.items()}

    def state_dict(self) -> dict[str, Any]:
        """Everything needed to continue bit for bit; plain tensors, on the processor, and names."""
        memory = {name: value.cpu().clone() for name, value in self._memory.items()}
        return {**self.belief.state_dict(), "memory": memory, "generator": self.generator.get_state()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from :meth:`state_dict`.

        Raises `InputError` if it was saved by an estimator of other parameters, vehicles or settings, or has other
        shapes or types than this one saves; nothing is then changed.
        """
        own = self.state_dict()
        for key in ("mode", "names"):
            if isinstance(state, dict) and state.get(key) != own.get(key):
                found = f"{str(state.get(key))[:80]} when it was saved, here it is {own.get(key)}"
                raise InputError(f"state: {key} was {found}")
        shaped_as(own, state, "state")
        self.belief = Belief.of_state(state, self.device)
        self._memory = {name: value.clone().to(self.device) for name, value in state["memory"].items()}
        self.generator.set_state(state["generator"])


class WindowedEstimator(Estimator):
    """An estimator that works on the rows of the excited windows.

    `form`: what is measured; the belief has its parameters. Takes the other arguments of :class:`Estimator`.
    """

    def __init__(self, form: Form, **options: Any) -> None:
        super().__init__(form.names, form.noise_prior, **options)
        self.form = form

    def take(self, rows: Rows, likelihood: WindowLikelihood) -> Belief:
        """Take in one window of every vehicle; those that are not excited keep their belief."""

        def learn(index: Tensor) -> tuple[Summary, Tensor]:
            excited = {name: rows[name][index] for name in ("usable", *self.form.columns)}
            return self._learn({"time": rows["time"], **excited}, index)

        return self._updated(likelihood.excited, learn)

    @abstractmethod
    def _learn(self, rows: Rows, index: Tensor) -> tuple[Summary, Tensor]:
        """The summary of the vehicles ``index`` from their rows, and where it may be used, ``(vehicle,)`` bool."""


def shaped_as(own: Any, given: Any, place: str) -> None:
    """Check a saved state against one's own: the same keys, types, dtypes and shapes, and finite numbers throughout.

    What was damaged on its way is found by the checksum of the file that holds it. Raises `InputError` that names the
    `place` within the state.
    """
    if isinstance(own, Tensor):
        if not isinstance(given, Tensor) or given.dtype != own.dtype or given.shape != own.shape:
            found = f"{given.dtype} of shape {tuple(given.shape)}" if isinstance(given, Tensor) else _kind(given)
            raise InputError(f"{place}: found {found}, needs {own.dtype} of shape {tuple(own.shape)}")
        if own.dtype.is_floating_point and not bool(given.isfinite().all()):
            raise InputError(f"{place}: holds numbers that are not finite")
    elif type(given) is not type(own):
        raise InputError(f"{place}: found {_kind(given)}, needs {_kind(own)}")
    elif isinstance(own, Mapping):
        if set(given) != set(own):
            found, needed = (", ".join(sorted(map(str, x)))[:200] or "nothing" for x in (given, own))
            raise InputError(f"{place}: found {found}, needs {needed}")
        for key, value in own.items():
            shaped_as(value, given[key], f"{place}.{key}")
    elif isinstance(own, (list, tuple)):
        if len(given) != len(own):
            raise InputError(f"{place}: found {len(given)} entries, needs {len(own)}")
        for i, value in enumerate(own):
            shaped_as(value, given[i], f"{place}[{i}]")


def _kind(x: Any) -> str:
    return f"a {type(x).__name__}"
