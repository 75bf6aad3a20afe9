"""The loop over windows: each window's posterior is the next one's prior (paper, Sec. 3.2.3), batched over vehicles."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor

from avtorch.arrays import Bool
from avtorch.errors import InputError
from avtorch.inference.belief import Belief, Summary
from avtorch.inference.density import Density, SelectableDensity
from avtorch.inference.device import Device, checked_device, generator_on
from avtorch.inference.form import Rows, WindowLikelihood
from avtorch.inference.importance import ImportanceSettings, WeightedDraws, approximated, weighted_draws
from avtorch.inference.map import Mode, find_mode
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


WIDEST = 3.0
"""SD of a logarithm, twice the widest prior's, above which the curvature at the mode does not describe the
posterior."""


class MaximumAPosteriori(SequentialInference):
    """The same windows, densities and priors as SGLD's loop; each posterior is replaced by a normal in the log space.

    Its mean is the mode and its covariance the inverse curvature there (Laplace), so that the belief's median is the
    mode and its draws are log-normal. Exact where the log posterior is quadratic; the long tail of a skewed one is
    lost.

    Takes the arguments of :class:`SequentialInference`; ``settings`` do not apply.
    """

    def _solve(self, density: Density) -> tuple[Summary, Tensor, Tensor, Tensor]:
        mode = find_mode(density)
        converged = mode.converged & (mode.covariance.diagonal(dim1=-2, dim2=-1).amax(-1) < WIDEST**2)
        # the others are not used; any finite covariance will do
        covariance = torch.where(
            converged[:, None, None],
            mode.covariance,
            torch.eye(mode.z.shape[-1], dtype=mode.z.dtype, device=mode.z.device),
        )
        summary = Summary.log_normal(mode.z, covariance, len(self.belief.draws), self.generator)
        return summary, mode.z, covariance, converged


AGAINST_SGLD = (
    "Importance sampling in place of SGLD, whose gradients are dear here: on 24 windows its means lay within 0.08 SD "
    "of a long reference in 95 %, SGLD's within 0.18."
)
"""The estimator's error beside SGLD's, for answers; `benchmarks/estimators.md` has the table."""

FIRST = ImportanceSettings()
WIDER = ImportanceSettings(draws=512, rounds=8, degrees=3, width=1.3)
"""Tried where the first draws' weights are not reliable: heavier and wider proposals, up to twice as many draws."""
MANY = ImportanceSettings(draws=4096, rounds=8, enough=1000.0, degrees=3, width=1.3)
"""Tried where those are not reliable either: up to eight times as many, for a fifth of the time of SGLD's chains,
and far less than that where rows are uneven."""


class ImportanceSampling(SequentialInference):
    """The same windows, densities and priors as SGLD's loop; each posterior by weighted draws (`weighted_draws`).

    A window whose weights are not reliable is drawn again, from wider proposals and then from many. Where they are not
    reliable either, it is sampled by SGLD, with ``settings``.

    Takes the arguments of :class:`SequentialInference`.
    """

    def _solve(self, density: Density) -> tuple[Summary, Tensor, Tensor, Tensor]:
        # proposals need no better mode: it is within a hundredth of an SD
        mode = find_mode(approximated(density), from_values=True, tolerance=5e-5)
        found = self._drawn(density, mode, FIRST)
        for attempt in (partial(self._drawn, settings=WIDER), partial(self._drawn, settings=MANY), self._chains):
            again = (~found.converged).nonzero().squeeze(-1)
            if not len(again):
                break
            if len(again) == density.windows:
                found = attempt(density, mode)
            elif isinstance(density, SelectableDensity):
                found = found.replaced(again, attempt(density.select(again), mode.select(again)))
        return found.summary, found.mean_z, found.cov_z, found.converged

    def _drawn(self, density: Density, mode: Mode, settings: ImportanceSettings) -> _Solved:
        draws = weighted_draws(density, settings, generator=self.generator, mode=mode)
        summary = _summary(draws, len(self.belief.draws), self.generator)
        return _Solved(summary, *draws.moments(), mode.converged & draws.converged(settings))

    def _chains(self, density: Density, mode: Mode) -> _Solved:
        return _Solved(*super()._solve(density))


class _Solved(NamedTuple):
    """The posterior of some vehicles: summary, log moments, and where it converged ``(vehicle,)`` bool."""

    summary: Summary
    mean_z: Tensor
    cov_z: Tensor
    converged: Tensor

    def replaced(self, index: Tensor, other: _Solved) -> _Solved:
        """The vehicles ``index`` taken from ``other``."""

        def put(mine: Tensor, theirs: Tensor, dim: int = 0) -> Tensor:
            return mine.index_copy(dim, index, theirs)

        mean, sd, q05, q95 = (put(*pair) for pair in zip(self.summary[:4], other.summary[:4], strict=True))
        summary = Summary(mean, sd, q05, q95, put(self.summary.draws, other.summary.draws, 1))
        return _Solved(
            summary,
            put(self.mean_z, other.mean_z),
            put(self.cov_z, other.cov_z),
            put(self.converged, other.converged),
        )


def _summary(draws: WeightedDraws, kept: int, generator: torch.Generator) -> Summary:
    value, weight = draws.z.exp(), draws.weight[..., None]
    mean = (weight * value).sum(0)
    sd = (weight * (value - mean).square()).sum(0).sqrt()
    low, high = draws.quantile(0.05).exp(), draws.quantile(0.95).exp()
    return Summary(mean, sd, low, high, draws.equal(kept, generator).exp())
