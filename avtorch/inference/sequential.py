"""The loop over windows: each window's posterior is the next one's prior (paper, Sec. 3.2.3), batched over vehicles."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor

from avtorch.arrays import Bool, Float, Int
from avtorch.errors import InputError
from avtorch.inference.belief import Belief, Summary
from avtorch.inference.chains import quantiles_of
from avtorch.inference.density import Density
from avtorch.inference.estimator import Estimator
from avtorch.inference.form import Rows, WindowLikelihood
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
