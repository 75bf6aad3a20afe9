"""The loop over windows: each window's posterior is the next one's prior (paper, Sec. 3.2.3), batched over vehicles."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import torch
from torch import Tensor

from avtorch.errors import InputError
from avtorch.inference.density import Density
from avtorch.inference.posterior import sorted_quantile
from avtorch.inference.priors import (
    Joint,
    LogSpaceNormal,
    Prior,
    QuadrantNormal,
    Switch,
    default_actuation_prior,
    default_jerk_noise_prior,
)
from avtorch.inference.sampler import SamplerSettings, sample

Mode = Literal["lambda", "posterior", "forgetting"]


@dataclass(frozen=True)
class Belief:
    """What is believed of every vehicle after a window.

    Attributes:
        names: parameter names, ``T_L`` [s] and ``K_L`` [-] first, then the noise parameters.
        mean, sd, q05, q95: shape ``(vehicle, parameter)``.
        draws: ``(draw, vehicle, parameter)``.
        excited: ``(vehicle,)`` bool; where false the window was not used and the rest is carried over unchanged.
        converged: ``(vehicle,)`` bool; false where the window was excited but its chains did not settle: carried over,
            too.
    """

    names: tuple[str, ...]
    mean: Tensor
    sd: Tensor
    q05: Tensor
    q95: Tensor
    draws: Tensor
    excited: Tensor
    converged: Tensor

    def stat(self, name: str, vehicle: int = 0) -> dict[str, float]:
        """``{"mean", "sd", "q05", "q95"}`` of one parameter of one vehicle."""
        i = self.names.index(name)
        return {key: float(getattr(self, key)[vehicle, i]) for key in ("mean", "sd", "q05", "q95")}


class SequentialInference:
    """Beliefs about ``(T_L, K_L, noise...)`` of many vehicles, updated window by window.

    The prior of a window is, by ``mode``,

    - ``"lambda"``: ``N([K, T] of the last mean, lambda I)`` on the positive quadrant (the paper's), noise prior afresh;
    - ``"posterior"``: the last posterior, as a normal with full covariance in the log parameters, noise included;
    - ``"forgetting"``: the same with the covariance divided by ``forgetting``, so that old windows fade.

    ``"posterior"`` holds the vehicle for constant, and ``"forgetting"`` for slowly drifting: after a sudden change both
    stay where they were for many windows and raise the noise instead. ``"lambda"`` follows within a window or two.

    Before a vehicle's first excited window its prior is ``first_prior``. Memory does not grow with the windows.

    Args:
        vehicles: how many run side by side.
        lam: the paper's ``lambda``: a variance in ``s^2`` and ``-``.
        forgetting: in (0, 1]; 1 forgets nothing.
        noise_prior: prior of the noise parameters of every window.
        kept: draws per vehicle that a belief carries.

    Raises:
        InputError: for a mode, ``lam`` or ``forgetting`` out of range.
    """

    def __init__(
        self,
        *,
        vehicles: int = 1,
        mode: Mode = "lambda",
        lam: float = 0.25,
        forgetting: float = 0.9,
        names: tuple[str, ...] = ("T_L", "K_L", "sigma"),
        actuation_prior: Prior | None = None,
        noise_prior: Prior | None = None,
        settings: SamplerSettings | None = None,
        kept: int = 1000,
        seed: int = 0,
    ) -> None:
        if mode not in ("lambda", "posterior", "forgetting"):
            raise InputError(f"mode: {mode!r} is none of 'lambda', 'posterior', 'forgetting'")
        if kept < 2 or vehicles < 1:
            raise InputError(f"kept, vehicles: found {kept}, {vehicles}, need 2 or more draws and 1 or more vehicles")
        if not lam > 0:
            raise InputError(f"lam: {lam} is not a positive variance")
        if not 0 < forgetting <= 1:
            raise InputError(f"forgetting: {forgetting} is not in (0, 1]")
        self.mode, self.lam, self.forgetting = mode, lam, forgetting
        self.settings = SamplerSettings() if settings is None else settings
        self.noise_prior = default_jerk_noise_prior() if noise_prior is None else noise_prior
        self.first_prior = Joint(
            default_actuation_prior() if actuation_prior is None else actuation_prior, self.noise_prior
        )
        self.generator = torch.Generator().manual_seed(seed)
        draws = self.first_prior.sample(kept, vehicles, generator=self.generator)
        never = torch.zeros(vehicles, dtype=torch.bool)
        self.belief = _summarise(names, draws.exp(), excited=never, converged=~never)
        self._started = never.clone()
        self._mean_z = draws.mean(0)
        self._cov_z = torch.eye(len(names), dtype=torch.float64).repeat(vehicles, 1, 1)

    def prior(self) -> Prior:
        """The prior of the coming window, for all vehicles."""
        later: Prior
        if self.mode == "lambda":
            later = Joint(QuadrantNormal(self.belief.mean[:, :2], self.lam), self.noise_prior)
        else:
            widening = 1.0 if self.mode == "posterior" else 1 / self.forgetting
            later = LogSpaceNormal(self._mean_z, widening * self._cov_z)
        return Switch(self._started, self.first_prior, later)

    def update(self, density: Callable[[Tensor, Prior], Density], excited: Tensor) -> Belief:
        """Take in one window of every vehicle.

        Args:
            density: builds the posterior density of the vehicles named by an index from their priors.
            excited: ``(vehicle,)`` bool; the others keep their belief.
        """
        index = excited.nonzero().squeeze(-1)
        old = self.belief
        draws, converged = old.draws, torch.ones_like(excited)
        table = {key: getattr(old, key) for key in ("mean", "sd", "q05", "q95")}
        if len(index):
            posterior = sample(density(index, self.prior().select(index)), self.settings, generator=self.generator)
            settled = posterior.converged
            converged = converged.index_put((index,), settled)
            used, good = index[settled], settled.nonzero().squeeze(-1)
            if len(used):
                ordered = posterior.flat[:, good].sort(0).values
                new = {
                    "mean": posterior.mean[good],
                    "sd": posterior.sd[good],
                    "q05": sorted_quantile(ordered, 0.05),
                    "q95": sorted_quantile(ordered, 0.95),
                }
                table = {key: old_value.index_put((used,), new[key]) for key, old_value in table.items()}
                mean_z, cov_z = posterior.log_moments()
                self._mean_z = self._mean_z.index_put((used,), mean_z[good])
                self._cov_z = self._cov_z.index_put((used,), cov_z[good])
                self._started = self._started.index_put((used,), torch.tensor(True))
                draws = draws.clone()
                draws[:, used] = _thin(posterior.flat[:, good], len(draws))
        self.belief = Belief(old.names, draws=draws, excited=excited, converged=converged, **table)
        return self.belief

    def state_dict(self) -> dict[str, Any]:
        """Everything a resumed loop needs to go on equal to the bit; plain tensors and names."""
        b = self.belief
        tensors = {key: getattr(b, key) for key in ("mean", "sd", "q05", "q95", "draws", "excited", "converged")}
        own = {
            "started": self._started,
            "mean_z": self._mean_z,
            "cov_z": self._cov_z,
            "generator": self.generator.get_state(),
        }
        return {"names": list(b.names), "mode": self.mode, **tensors, **own}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from :meth:`state_dict`.

        Raises:
            InputError: if it was saved by a loop of another mode or other parameters.
        """
        saved = (state["mode"], tuple(state["names"]), len(state["mean"]))
        own = (self.mode, self.belief.names, len(self.belief.mean))
        if saved != own:
            raise InputError(f"state: (mode, names, vehicles) were {saved} when it was saved, here they are {own}")
        keys = ("mean", "sd", "q05", "q95", "draws", "excited", "converged")
        self.belief = Belief(self.belief.names, **{key: state[key].clone() for key in keys})
        self._started, self._mean_z, self._cov_z = (state[key].clone() for key in ("started", "mean_z", "cov_z"))
        self.generator.set_state(state["generator"])


def _thin(draws: Tensor, count: int) -> Tensor:
    """``count`` draws spread evenly over the first dimension (repeated where there are fewer)."""
    return draws[torch.linspace(0, len(draws) - 1, count, dtype=torch.float64).round().long()]


def _summarise(names: tuple[str, ...], draws: Tensor, *, excited: Tensor, converged: Tensor) -> Belief:
    ordered = draws.sort(0).values
    quantiles = (sorted_quantile(ordered, 0.05), sorted_quantile(ordered, 0.95))
    return Belief(names, draws.mean(0), draws.std(0), *quantiles, draws, excited, converged)
