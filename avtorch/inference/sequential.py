"""The loop over windows: each window's posterior is the next one's prior (paper, Sec. 3.2.3), batched over vehicles."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal

import torch
from torch import Tensor

from avtorch.arrays import Bool
from avtorch.errors import InputError
from avtorch.inference.belief import Belief, Summary
from avtorch.inference.density import Density
from avtorch.inference.device import Device, checked_device, generator_on
from avtorch.inference.form import Rows, WindowLikelihood
from avtorch.inference.posterior import quantile_of
from avtorch.inference.priors import (
    Joint,
    LogSpaceNormal,
    Prior,
    QuadrantNormal,
    Switch,
    default_actuation_prior,
    default_jerk_noise_prior,
    prior_on,
)
from avtorch.inference.sampler import sample
from avtorch.inference.sampler_settings import SamplerSettings
from avtorch.inference.state import about, shaped_as

CarriedBy = Literal["lambda", "posterior", "forgetting"]


class SequentialInference:
    """Beliefs about ``(T_L, K_L, noise...)`` of many vehicles, updated window by window.

    The prior of a window is, by ``mode``,

    - ``"lambda"``: ``N([K, T] of the last mean, lambda I)`` on the positive quadrant (the paper's), noise prior afresh;
    - ``"posterior"``: the last posterior, as a normal with full covariance in the log parameters, noise included;
    - ``"forgetting"``: the same with the covariance divided by ``forgetting``, so that old windows fade.

    ``"posterior"`` assumes a constant vehicle, and ``"forgetting"`` a slowly drifting one: after a sudden change the
    estimates of both stay unchanged for many windows while the noise estimate rises. ``"lambda"`` follows within a
    window or two.

    Before a vehicle's first excited window its prior is ``first_prior``. Memory does not grow with the windows.

    Args:
        vehicles: how many run side by side.
        lam: the paper's ``lambda``: a variance in ``s^2`` and ``-``.
        forgetting: in (0, 1]; 1 forgets nothing.
        noise_prior: prior of the noise parameters of every window.
        kept: draws per vehicle that a belief carries.
        device: where beliefs are and posteriors are sampled; densities of `update` have to be there.

    Raises `InputError` for a mode, ``lam`` or ``forgetting`` out of range, or a device that this machine lacks.

    Example:
        >>> import torch
        >>> from avtorch.inference import JerkDensity, SequentialInference
        >>> from avtorch.validation import synthetic_windows
        >>> vehicle, window = SequentialInference(mode="posterior"), synthetic_windows(1, seed=1).density
        >>> for _ in range(2):  # the same window twice: the belief narrows
        ...     density = lambda index, prior: JerkDensity(window.statistics, prior)
        ...     belief = vehicle.update(density, excited=torch.tensor([True]))
        ...     print(belief.converged.item(), round(belief.stat("K_L")["sd"], 3))
        True 0.015
        True 0.01
    """

    def __init__(
        self,
        *,
        vehicles: int = 1,
        mode: CarriedBy = "lambda",
        lam: float = 0.25,
        forgetting: float = 0.9,
        names: tuple[str, ...] = ("T_L", "K_L", "sigma"),
        actuation_prior: Prior | None = None,
        noise_prior: Prior | None = None,
        settings: SamplerSettings | None = None,
        kept: int = 1000,
        seed: int = 0,
        device: Device = "cpu",
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
        self.device = checked_device(device)
        self.noise_prior = prior_on(default_jerk_noise_prior() if noise_prior is None else noise_prior, self.device)
        first = default_actuation_prior() if actuation_prior is None else actuation_prior
        self.first_prior = Joint(prior_on(first, self.device), self.noise_prior)
        self.generator = generator_on(self.device, seed)
        self.belief = Belief.of_prior(names, self.first_prior, kept, vehicles, self.generator)
        self._started = torch.zeros(vehicles, dtype=torch.bool, device=self.device)
        self._mean_z = self.belief.draws.log().mean(0)
        self._cov_z = torch.eye(len(names), dtype=torch.float64, device=self.device).repeat(vehicles, 1, 1)

    def prior(self) -> Prior:
        """The prior of the coming window, for all vehicles."""
        later: Prior
        if self.mode == "lambda":
            later = Joint(QuadrantNormal(self.belief.mean[:, :2], self.lam), self.noise_prior)
        else:
            widening = 1.0 if self.mode == "posterior" else 1 / self.forgetting
            later = LogSpaceNormal(self._mean_z, widening * self._cov_z)
        return Switch(self._started, self.first_prior, later)

    def update(self, density: Callable[[Tensor, Prior], Density], excited: Bool[Tensor, " vehicle"]) -> Belief:
        """Take in one window of every vehicle.

        `density`: builds the posterior density of the vehicles named by an index from their priors. `excited`:
        ``(vehicle,)`` bool; the others keep their belief.
        """
        excited = excited.to(self.device)
        index = excited.nonzero().squeeze(-1)
        if not len(index):
            self.belief = self.belief.unused(excited)
            return self.belief
        found, mean_z, cov_z, converged = self._solve(density(index, self.prior().select(index)))
        used = index[converged]
        self._mean_z = self._mean_z.index_put((used,), mean_z[converged])
        self._cov_z = self._cov_z.index_put((used,), cov_z[converged])
        self._started = self._started.index_fill(0, used, True)
        self.belief = self.belief.updated(excited, index, found, converged)
        return self.belief

    def take(self, rows: Rows, likelihood: WindowLikelihood) -> Belief:
        """:meth:`update` with the interface of an estimator of a stream; the likelihood contains all that is needed of
        the rows."""
        return self.update(likelihood.density, likelihood.excited)

    def _solve(self, density: Density) -> tuple[Summary, Tensor, Tensor, Tensor]:
        """Posterior of some vehicles: its summary, log moments, and where it converged ``(vehicle,)`` bool."""
        posterior = sample(density, self.settings, generator=self.generator)
        quantiles = quantile_of(posterior.flat, 0.05), quantile_of(posterior.flat, 0.95)
        draws = _thin(posterior.flat, len(self.belief.draws))
        summary = Summary(posterior.mean, posterior.sd, *quantiles, draws)
        return summary, *posterior.log_moments(), posterior.converged

    def state_dict(self) -> dict[str, Any]:
        """Everything a resumed loop needs to continue bit for bit; plain tensors, on the processor, and
        names."""
        own = {
            "started": self._started.cpu(),
            "mean_z": self._mean_z.cpu(),
            "cov_z": self._cov_z.cpu(),
            "generator": self.generator.get_state(),
        }
        return {"mode": self.mode, **self.belief.state_dict(), **own}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from :meth:`state_dict`.

        Raises `InputError` if it was saved by a loop of another mode or other parameters, or has other shapes or types
        than this one saves; nothing is then changed.
        """
        saved = about(state, "mode")
        own = about(self.state_dict(), "mode")
        if saved != own:
            raise InputError(f"state: (mode, names, vehicles) were {saved} when it was saved, here they are {own}")
        shaped_as(self.state_dict(), state, "state")
        self.belief = self.belief.taken_from(state)
        self._started, self._mean_z, self._cov_z = (
            state[key].clone().to(self.device) for key in ("started", "mean_z", "cov_z")
        )
        self.generator.set_state(state["generator"])


def _thin(draws: Tensor, count: int) -> Tensor:
    """``count`` draws spread evenly over the first dimension (repeated where there are fewer)."""
    return draws[torch.linspace(0, len(draws) - 1, count, dtype=torch.float64, device=draws.device).round().long()]
