"""The same posterior as a Pyro model, and full-batch NUTS over it: an independent reference.

Needs the extra ``nuts`` (Pyro), so import it by its path. Priors are ``pyro.sample`` statements; the jerk likelihood is
one, too, where the rows are given, and otherwise a factor. In ``z = log(parameter)``, with Pyro's own Jacobian, the
model's log density equals that of the density it was made from.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, cast

import torch
from torch import Tensor
from torch.distributions.constraints import Constraint

from avtorch.arrays import Float
from avtorch.errors import InputError
from avtorch.inference.chains import nested_rhat
from avtorch.inference.density import Density, ScoredDensity, SelectableDensity
from avtorch.inference.jerk import JerkDensity
from avtorch.inference.map import find_mode
from avtorch.inference.posterior import Posterior
from avtorch.inference.priors import HalfNormalPrior, Joint, LogNormalPrior, LogSpaceNormal, Prior, QuadrantNormal
from avtorch.vehicle.glvd import glvd_jerk

try:
    import pyro
    import pyro.distributions as dist
    from pyro.infer import MCMC, NUTS
    from pyro.infer.mcmc.util import initialize_model
except ImportError as missing:
    raise ImportError("avtorch.inference.nuts: needs Pyro; pip install 'avtorch[nuts]'") from missing


class _WithPrior(SelectableDensity, Protocol):
    prior: Prior


class PositiveNormal(dist.TorchDistribution):
    """``Normal(loc, scale)`` cut off at zero and renormalised; Pyro has none."""

    def __init__(self, loc: Float[Tensor, "*#batch"], scale: Float[Tensor, "*#batch"]) -> None:
        self.loc, self.scale = torch.broadcast_tensors(loc, scale)
        super().__init__(self.loc.shape, validate_args=False)

    @property
    def support(self) -> Constraint:
        return dist.constraints.positive

    def log_prob(self, value: Tensor) -> Tensor:
        inside = torch.special.log_ndtr(self.loc / self.scale)
        return dist.Normal(self.loc, self.scale).log_prob(value) - inside

    def sample(self, sample_shape: torch.Size = torch.Size()) -> Tensor:  # noqa: B008
        below = torch.special.ndtr(-self.loc / self.scale)
        uniform = torch.rand(self._extended_shape(sample_shape), dtype=self.loc.dtype, device=self.loc.device)
        cut = (below + (1 - below) * uniform).clamp(1e-300, 1 - 1e-16)
        return (self.loc + self.scale * torch.special.ndtri(cut)).clamp_min(1e-12)


@dataclass(frozen=True)
class _Site:
    """One ``pyro.sample`` of the model and the columns of ``z`` it fills; ``log_space``: the sample itself is ``z``."""

    name: str
    columns: tuple[int, ...]
    law: dist.TorchDistribution
    log_space: bool

    def z(self, value: Tensor) -> Tensor:
        return (value if self.log_space else value.log()).reshape(len(self.columns))

    def unconstrained(self, z: Tensor) -> Tensor:
        """Pyro's unconstrained coordinates: ``z`` in either case, as Pyro maps positive parameters by ``exp``."""
        return z[list(self.columns)].reshape(self.law.batch_shape + self.law.event_shape)


def _sites(prior: Prior, names: tuple[str, ...], first: int = 0) -> list[_Site]:
    """The prior of a single window as named distributions."""
    if isinstance(prior, Joint):
        return [*_sites(prior.actuation, names[:2], first), *_sites(prior.noise, names[2:], first + 2)]
    if isinstance(prior, LogSpaceNormal):
        law = dist.MultivariateNormal(prior.mean_z[0], covariance_matrix=prior.cov_z[0])
        return [_Site("log_" + "_".join(names), tuple(range(first, first + len(names))), law, True)]
    laws: list[dist.TorchDistribution]
    if isinstance(prior, LogNormalPrior):
        laws = [dist.LogNormal(m.log(), s) for m, s in zip(prior.median, prior.log_sd, strict=True)]
    elif isinstance(prior, HalfNormalPrior):
        laws = [dist.HalfNormal(scale) for scale in prior.scale]
    elif isinstance(prior, QuadrantNormal):
        sd = torch.as_tensor(prior.variance, dtype=torch.float64, device=prior.mean.device).sqrt()
        laws = [PositiveNormal(mean, sd) for mean in prior.mean.reshape(-1)]
    else:
        raise InputError(f"prior: no Pyro distribution is known for {type(prior).__name__}")
    return [_Site(name, (first + i,), law, False) for i, (name, law) in enumerate(zip(names, laws, strict=True))]


class PyroModel:
    """One window of a density as a Pyro model: call it to run its statements.

    `density`: a density with a ``prior`` of `avtorch.inference.priors`. `window`: which of its windows. `samples`:
    ``(a, u, jerk)`` [m/s^2, m/s^2, m/s^3], each ``(time,)``: the rows behind a jerk density, whose likelihood then is
    an observed statement, Eq. 4 row by row; without them it is a factor.

    Raises `InputError` for a window out of range, a prior unknown here, or samples with a density of another form.
    """

    def __init__(
        self,
        density: _WithPrior,
        *,
        window: int = 0,
        samples: tuple[Float[Tensor, " time"], Float[Tensor, " time"], Float[Tensor, " time"]] | None = None,
    ) -> None:
        if not 0 <= window < density.windows:
            raise InputError(f"window: {window} is not in 0 to {density.windows - 1}")
        if samples is not None and not isinstance(density, JerkDensity):
            raise InputError(f"samples: the form of {type(density).__name__} is not that of measured jerk")
        index = torch.tensor([window], device=getattr(density.prior, "device", None))
        self.density, self.samples = density.select(index), samples
        self.names = density.names
        self.sites = _sites(density.prior.select(index), density.names)

    def __call__(self) -> None:
        z = torch.cat([site.z(cast(Tensor, pyro.sample(site.name, site.law))) for site in self.sites])
        if self.samples is None:
            prior = cast(Prior, self.density.prior)  # pyright: ignore[reportAttributeAccessIssue]
            pyro.factor("likelihood", (self.density.log_prob(z[None]) - prior.log_prob(z[None]))[0])
            return
        a, u, jerk = self.samples
        T_L, K_L, sigma = z.exp()
        with pyro.plate("time", len(jerk)):
            pyro.sample("jerk", dist.Normal(glvd_jerk(a, u, T_L, K_L), sigma), obs=jerk)

    def unconstrained(self, z: Float[Tensor, " parameter"]) -> dict[str, Tensor]:
        """``z`` ``(parameter,)`` as Pyro's unconstrained sites."""
        return {site.name: site.unconstrained(z) for site in self.sites}

    def log_prob(self, z: Float[Tensor, " parameter"]) -> Float[Tensor, ""]:
        """Pyro's own log density of ``z`` ``(parameter,)``, Jacobian included: minus the potential of NUTS."""
        _, potential, _, _ = initialize_model(self, initial_params=self.unconstrained(z))
        return -potential(self.unconstrained(z))


def nuts(
    density: _WithPrior,
    *,
    window: int = 0,
    chains: int = 1,
    draws: int = 1000,
    warmup: int = 500,
    seed: int = 0,
    rhat_max: float = 1.1,
) -> Posterior:
    """Full-batch NUTS with a dense mass matrix over one window of a density, by Pyro.

    Chains start from the Laplace approximation at the mode and run one after another. PyTorch's global random state is
    unchanged.

    Pyro's sampler is given the log density as a function, which takes a tenth of the time of tracing the statements of
    :class:`PyroModel` at every step. `window`: which of the density's. `warmup`: steps of adaptation, dropped.

    Returns:
        Draws ``(chain, draw, 1, parameter)``; ``converged`` is false where R-hat exceeds ``rhat_max`` or more than 1 %
        of the draws diverged.
    """
    alone = density.select(torch.tensor([window], device=getattr(density.prior, "device", None)))
    mode, potential = find_mode(alone), _potential(alone)
    walked, diverged = [], 0
    with torch.random.fork_rng(devices=[mode.z.device] if mode.z.device.type == "cuda" else []):
        torch.manual_seed(seed)
        for _ in range(chains):
            start = {"z": mode.z[0] + mode.scale[0] @ torch.randn_like(mode.z[0])}
            kernel = NUTS(full_mass=True, potential_fn=potential)
            run = MCMC(kernel, draws, warmup, initial_params=start, disable_progbar=True)
            run.run()
            walked.append(run.get_samples()["z"])
            diverged += sum(len(v) for v in run.diagnostics()["divergences"].values())
    z = torch.stack(walked).unsqueeze(2)
    converged = (nested_rhat(z).amax(-1) <= rhat_max) & (diverged <= 0.01 * chains * draws)
    return Posterior(density.names, z.exp(), converged)


class _Scored(torch.autograd.Function):
    """The potential of a density that gives its own gradient."""

    @staticmethod
    def forward(ctx, z: Tensor, density: ScoredDensity) -> Tensor:
        ctx.save_for_backward(z)
        ctx.density = density
        return -density.log_prob(z[None])[0]

    @staticmethod
    def backward(ctx, gradient: Tensor) -> tuple[Tensor, None]:  # pyright: ignore[reportIncompatibleMethodOverride]
        (z,) = ctx.saved_tensors
        return -gradient * ctx.density.score(z[None])[0], None


def _potential(alone: Density) -> Callable[[dict[str, Tensor]], Tensor]:
    """``U`` of a single window as Pyro calls it."""
    if isinstance(alone, ScoredDensity):
        return lambda p: cast(Tensor, _Scored.apply(p["z"], alone))
    return lambda p: -alone.log_prob(p["z"][None])[0]
