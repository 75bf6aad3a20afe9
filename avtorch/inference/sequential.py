"""The loop over windows: each window's posterior is the next one's prior (paper, Sec. 3.2.3), batched over vehicles.

The posterior of each window is SGLD's; or, of the same density, the mode with its curvature, or weighted draws.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor

from avtorch.arrays import Bool, Float, Int
from avtorch.errors import InputError
from avtorch.inference.belief import Belief, Summary
from avtorch.inference.chains import quantiles_of
from avtorch.inference.density import Density, SelectableDensity
from avtorch.inference.estimator import Estimator, Rows, WindowLikelihood
from avtorch.inference.importance import ImportanceSettings, WeightedDraws, weighted_draws
from avtorch.inference.map import Mode, find_mode
from avtorch.inference.priors import Joint, LogSpaceNormal, Prior, QuadrantNormal, Switch, default_jerk_noise_prior
from avtorch.inference.sampler import sample
from avtorch.inference.sampler_settings import SamplerSettings

CarriedBy = Literal["lambda", "posterior", "forgetting"]


class Solved(NamedTuple):
    """The posterior of some vehicles: summary, log moments, and where it converged ``(vehicle,)`` bool."""

    summary: Summary
    mean_z: Float[Tensor, "vehicle parameter"]
    cov_z: Float[Tensor, "vehicle parameter parameter"]
    converged: Bool[Tensor, " vehicle"]

    def put(self, index: Int[Tensor, " some"], other: Solved) -> Solved:
        """The vehicles ``index`` taken from ``other``."""
        rest = (mine.index_copy(0, index, theirs) for mine, theirs in zip(self[1:], other[1:], strict=True))
        return Solved(self.summary.put(index, other.summary), *rest)


class SequentialInference(Estimator):
    """Beliefs about ``(T_L, K_L, noise...)`` of many vehicles, updated window by window.

    The prior of a window is, by ``mode``,

    - ``"lambda"``: ``N([K, T] of the last mean, lambda I)`` on the positive quadrant (the paper's), noise prior afresh;
    - ``"posterior"``: the last posterior, as a normal with full covariance in the log parameters, noise included;
    - ``"forgetting"``: the same with the covariance divided by ``forgetting``, so that old windows fade.

    ``"posterior"`` assumes a constant vehicle, and ``"forgetting"`` a slowly drifting one: after a sudden change the
    estimates of both stay unchanged for many windows while the noise estimate rises. ``"lambda"`` follows within a
    window or two.

    Before a vehicle's first excited window its prior is ``first_prior``.

    Args:
        lam: the paper's ``lambda``: a variance in ``s^2`` and ``-``.
        forgetting: in (0, 1]; 1 forgets nothing.
        noise_prior: prior of the noise parameters of every window.
        **options: of :class:`Estimator` (``vehicles``, ``actuation_prior``, ``kept``, ``seed``, ``device``); densities
            of `update` have to be on that device.

    Raises `InputError` for a mode, ``lam`` or ``forgetting`` out of range, and as :class:`Estimator` does.

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
        mode: CarriedBy = "lambda",
        lam: float = 0.25,
        forgetting: float = 0.9,
        names: tuple[str, ...] = ("T_L", "K_L", "sigma"),
        noise_prior: Prior | None = None,
        settings: SamplerSettings | None = None,
        **options: Any,
    ) -> None:
        if mode not in ("lambda", "posterior", "forgetting"):
            raise InputError(f"mode: {mode!r} is none of 'lambda', 'posterior', 'forgetting'")
        if not lam > 0:
            raise InputError(f"lam: {lam} is not a positive variance")
        if not 0 < forgetting <= 1:
            raise InputError(f"forgetting: {forgetting} is not in (0, 1]")
        noise = default_jerk_noise_prior() if noise_prior is None else noise_prior
        super().__init__(names, noise, **options)
        self.mode, self.lam, self.forgetting = mode, lam, forgetting
        self.settings = SamplerSettings() if settings is None else settings
        self._memory = {
            "started": torch.zeros(self.vehicles, dtype=torch.bool, device=self.device),
            "mean_z": self.belief.draws.log().mean(0),
            "cov_z": torch.eye(len(names), dtype=torch.float64, device=self.device).repeat(self.vehicles, 1, 1),
        }

    def prior(self) -> Prior:
        """The prior of the coming window, for all vehicles."""
        later: Prior
        if self.mode == "lambda":
            later = Joint(QuadrantNormal(self.belief.mean[:, :2], self.lam), self.first_prior.noise)
        else:
            widening = 1.0 if self.mode == "posterior" else 1 / self.forgetting
            later = LogSpaceNormal(self._memory["mean_z"], widening * self._memory["cov_z"])
        return Switch(self._memory["started"], self.first_prior, later)

    def update(self, density: Callable[[Tensor, Prior], Density], excited: Bool[Tensor, " vehicle"]) -> Belief:
        """Take in one window of every vehicle.

        `density`: builds the posterior density of the vehicles named by an index from their priors. `excited`:
        ``(vehicle,)`` bool; the others keep their belief.
        """

        def learn(index: Tensor) -> tuple[Summary, Tensor]:
            summary, mean_z, cov_z, good = self._solve(density(index, self.prior().select(index)))
            started = torch.ones_like(good)[good]
            self._remember(index[good], mean_z=mean_z[good], cov_z=cov_z[good], started=started)
            return summary, good

        return self._updated(excited.to(self.device), learn)

    def take(self, rows: Rows, likelihood: WindowLikelihood) -> Belief:
        """:meth:`update` with the interface of an estimator of a stream; the likelihood contains all that is needed of
        the rows."""
        return self.update(likelihood.density, likelihood.excited)

    def _solve(self, density: Density) -> Solved:
        """The posterior of some vehicles."""
        posterior = sample(density, self.settings, generator=self.generator)
        flat = posterior.flat
        q05, q95 = quantiles_of(flat, 0.05, 0.95)
        # spread evenly over the draws, repeated where there are fewer
        kept = torch.linspace(0, len(flat) - 1, self.kept, dtype=torch.float64, device=flat.device).round().long()
        summary = Summary(posterior.mean, posterior.sd, q05, q95, flat[kept])
        return Solved(summary, *posterior.log_moments(), posterior.converged)

    def state_dict(self) -> dict[str, Any]:
        return {"mode": self.mode, **super().state_dict()}


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

    def _solve(self, density: Density) -> Solved:
        mode = find_mode(density)
        converged = mode.converged & (mode.covariance.diagonal(dim1=-2, dim2=-1).amax(-1) < WIDEST**2)
        # the others are not used; any finite covariance will do
        covariance = torch.where(
            converged[:, None, None],
            mode.covariance,
            torch.eye(mode.z.shape[-1], dtype=mode.z.dtype, device=mode.z.device),
        )
        summary = Summary.log_normal(mode.z, covariance, self.kept, self.generator)
        return Solved(summary, mode.z, covariance, converged)


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

    def _solve(self, density: Density) -> Solved:
        # proposals need no better mode: it is within a hundredth of an SD
        mode = find_mode(density, from_values=True, tolerance=5e-5)
        found = self._drawn(density, mode, FIRST)
        for attempt in (partial(self._drawn, settings=WIDER), partial(self._drawn, settings=MANY), self._chains):
            again = (~found.converged).nonzero().squeeze(-1)
            if not len(again):
                break
            if len(again) == density.windows:
                found = attempt(density, mode)
            elif isinstance(density, SelectableDensity):
                found = found.put(again, attempt(density.select(again), mode.select(again)))
        return found

    def _drawn(self, density: Density, mode: Mode, settings: ImportanceSettings) -> Solved:
        draws = weighted_draws(density, settings, generator=self.generator, mode=mode)
        summary = _summary(draws, self.kept, self.generator)
        return Solved(summary, *draws.moments(), mode.converged & draws.converged(settings))

    def _chains(self, density: Density, mode: Mode) -> Solved:
        return super()._solve(density)


def _summary(draws: WeightedDraws, kept: int, generator: torch.Generator) -> Summary:
    value, weight = draws.z.exp(), draws.weight[..., None]
    mean = (weight * value).sum(0)
    sd = (weight * (value - mean).square()).sum(0).sqrt()
    low, high = draws.quantile(0.05).exp(), draws.quantile(0.95).exp()
    return Summary(mean, sd, low, high, draws.equal(kept, generator).exp())
