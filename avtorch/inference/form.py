"""A form of the log density, and the likelihood that it gives of a window of rows."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Protocol

from torch import Tensor

from avtorch.arrays import Bool, Real
from avtorch.inference.density import Density
from avtorch.inference.excitation import ExcitationRule
from avtorch.inference.jerk import JerkDensity, JerkStatistics
from avtorch.inference.priors import Prior, default_jerk_noise_prior
from avtorch.inference.sampler_settings import SamplerSettings

Rows = Mapping[str, Tensor]
"""One window: ``time`` ``(time,)`` [s] and ``usable`` and the measured columns, each ``(vehicle, time)``."""


@dataclass(frozen=True)
class WindowLikelihood:
    """The likelihood of one window of every vehicle: with a prior it gives a posterior density.

    Attributes:
        n: usable rows, ``(vehicle,)``.
        excited: ``(vehicle,)`` bool, by the fixed rule.
        density: the posterior density of the vehicles named by an index, from their priors.

    Example:
        >>> import torch
        >>> from avtorch import GLVDPlant, Leader, simulate
        >>> from avtorch.inference import JerkForm
        >>> run = simulate(Leader.default(start=50.0, duration=4.0, dt=0.02), plant=GLVDPlant(0.5, 0.9))
        >>> rows = {"accel": run.accel[:, 0], "accel_cmd": run.accel_cmd[:, 0], "jerk": run.jerk[:, 0]}
        >>> likelihood = JerkForm().likelihood({**rows, "usable": torch.ones(1, 200, dtype=torch.bool)}, full=200)
        >>> likelihood.n.tolist(), likelihood.excited.tolist()
        ([200.0], [True])
    """

    n: Real[Tensor, " vehicle"]
    excited: Bool[Tensor, " vehicle"]
    density: Callable[[Tensor, Prior], Density]


class Form(Protocol):
    """A form of the log density: its columns, its parameters, and the likelihood of a window of rows.

    Example:
        >>> from avtorch.inference import Form, JerkForm
        >>> from avtorch.inference.latent_form import LatentForm
        >>> forms: list[Form] = [JerkForm(), LatentForm(accel=False, speed=True)]
        >>> [form.columns for form in forms]
        [('accel_cmd', 'accel', 'jerk'), ('accel_cmd', 'speed')]
    """

    @property
    def names(self) -> tuple[str, ...]: ...

    @property
    def columns(self) -> tuple[str, ...]: ...

    @property
    def noise_prior(self) -> Prior: ...

    @property
    def sampler(self) -> SamplerSettings:
        """Default settings of the sampler for its posteriors."""
        ...

    def likelihood(self, rows: Rows, full: float) -> WindowLikelihood:
        """The likelihood of a window; ``full`` is the number of rows of a complete one."""
        ...


class JerkForm:
    """Jerk is measured: Eq. 4 of the paper from six sums.

    Example:
        >>> from avtorch.inference import BeliefStream, ExcitationRule, JerkForm
        >>> strict = JerkForm(rule=ExcitationRule(sd_T=0.1, sd_K=0.1))  # uses fewer windows, each of them sharper
        >>> stream = BeliefStream(window=2.0, form=strict)
        >>> strict.names, strict.columns
        (('T_L', 'K_L', 'sigma'), ('accel_cmd', 'accel', 'jerk'))
    """

    names = ("T_L", "K_L", "sigma")
    columns = ("accel_cmd", "accel", "jerk")
    sampler = SamplerSettings()

    def __init__(self, *, rule: ExcitationRule | None = None, noise_prior: Prior | None = None) -> None:
        self.rule = ExcitationRule() if rule is None else rule
        self.noise_prior = default_jerk_noise_prior() if noise_prior is None else noise_prior

    def likelihood(self, rows: Rows, full: float) -> WindowLikelihood:
        statistics = JerkStatistics.from_samples(rows["accel"], rows["accel_cmd"], rows["jerk"], rows["usable"])
        statistics = statistics.with_least_noise()
        return WindowLikelihood(
            n=statistics.n,
            excited=self.rule(statistics, full),
            density=lambda index, prior: JerkDensity(statistics.select(index), prior),
        )
