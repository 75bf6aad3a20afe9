"""The interface of an estimator in a stream of windows, and what the recursive ones share: a belief per vehicle, which
is carried over where a window is not excited, and resume."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, Protocol

from torch import Tensor

from avtorch.errors import InputError
from avtorch.inference.belief import Belief, Summary
from avtorch.inference.device import Device, checked_device, generator_on
from avtorch.inference.form import Form, Rows, WindowLikelihood
from avtorch.inference.priors import Joint, LogNormalPrior, default_actuation_prior, prior_on
from avtorch.inference.state import about, shaped_as


class Estimator(Protocol):
    """Takes the windows of many vehicles one after another and keeps a belief about them.

    A window that is not excited leaves the belief of its vehicle as it was.
    """

    @property
    def belief(self) -> Belief:
        """The belief after the last window; before the first, the first prior."""
        ...

    def take(self, rows: Rows, likelihood: WindowLikelihood) -> Belief:
        """Take in one window: its rows, each column ``(vehicle, time)``, and what the form makes of them."""
        ...

    def state_dict(self) -> dict[str, Any]:
        """Plain tensors and names, from which a resumed estimator continues bit for bit."""
        ...

    def load_state_dict(self, state: dict[str, Any]) -> None: ...


class WindowedEstimator(ABC):
    """An estimator that works on the rows of the excited windows and remembers tensors, one entry a vehicle.

    Args:
        form: what is measured; the belief has its parameters.
        actuation_prior: of ``(T_L [s], K_L [-])`` before the first excited window.
        kept: draws per vehicle that a belief carries.
        device: where belief and memory are, and the rows of `take` have to be.

    Raises `InputError` for fewer than two draws or one vehicle, or a device that this machine lacks.
    """

    def __init__(
        self,
        form: Form,
        *,
        vehicles: int = 1,
        actuation_prior: LogNormalPrior | None = None,
        kept: int = 1000,
        seed: int = 0,
        device: Device = "cpu",
    ) -> None:
        if kept < 2 or vehicles < 1:
            raise InputError(f"kept, vehicles: found {kept}, {vehicles}, need 2 or more draws and 1 or more vehicles")
        self.form, self.kept, self.vehicles = form, kept, vehicles
        self.device = checked_device(device)
        given = default_actuation_prior() if actuation_prior is None else actuation_prior
        self.actuation_prior = given.to(self.device)
        self.generator = generator_on(self.device, seed)
        prior = Joint(self.actuation_prior, prior_on(form.noise_prior, self.device))
        self.belief = Belief.of_prior(form.names, prior, kept, vehicles, self.generator)
        self._memory: dict[str, Tensor] = {}

    def take(self, rows: Rows, likelihood: WindowLikelihood) -> Belief:
        """Take in one window of every vehicle; those that are not excited keep their belief."""
        index = likelihood.excited.nonzero().squeeze(-1)
        if len(index):
            excited = {name: rows[name][index] for name in ("usable", *self.form.columns)}
            found, converged = self._learn({"time": rows["time"], **excited}, index)
            self.belief = self.belief.updated(likelihood.excited, index, found, converged)
        else:
            self.belief = self.belief.unused(likelihood.excited)
        return self.belief

    @abstractmethod
    def _learn(self, rows: Rows, index: Tensor) -> tuple[Summary, Tensor]:
        """The summary of the vehicles ``index`` from their rows, and where it may be used, ``(vehicle,)`` bool."""

    def state_dict(self) -> dict[str, Any]:
        """Everything needed to continue bit for bit; plain tensors and names."""
        memory = {name: value.cpu().clone() for name, value in self._memory.items()}
        return {**self.belief.state_dict(), "memory": memory, "generator": self.generator.get_state()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from :meth:`state_dict`.

        Raises `InputError` if it was saved by an estimator of other parameters or vehicles, or has other shapes or
        types than it saves; nothing is then changed.
        """
        saved, own = about(state), about(self.state_dict())
        if saved != own:
            raise InputError(f"state: (names, vehicles) were {saved} when it was saved, here they are {own}")
        shaped_as(self.state_dict(), state, "state")
        self.belief = self.belief.taken_from(state)
        self._memory = {name: value.clone().to(self.device) for name, value in state["memory"].items()}
        self.generator.set_state(state["generator"])
