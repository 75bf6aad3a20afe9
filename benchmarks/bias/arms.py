"""The arms of the bias table: one sampler setting each."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import product
from typing import Literal

import torch
from torch import Tensor

from avtorch.inference import SGLD, SamplerSettings
from avtorch.inference.coordinates import Coordinates, Whitening, stiffness
from avtorch.inference.map import Mode
from avtorch.inference.sampler import walk
from avtorch.inference.sgld import harmonic, polynomial
from benchmarks.bias.control_variates import ControlVariates
from benchmarks.bias.law import sd_ratio
from benchmarks.bias.windows import Problem

Preconditioner = Literal["full", "diagonal", "none", "rmsprop"]
LONG = "20 000 steps: schedules, whitened"
SCHEDULES = {"eta_1/k": harmonic, "(1+k/100)^-1/3": polynomial}


@dataclass(frozen=True)
class Arm:
    """One row. Chains start at the posterior's mode unless ``start`` is ``"prior"``, the prior's centre.

    ``whitening="rmsprop"`` is pSGLD with Gamma and floor ``eps`` on isotropic coordinates,
    started around the mode: at the mode itself the first gradient is zero, and so would be the scale derived from it.
    """

    section: str
    step: float
    batch: int | None = None
    whitening: Preconditioner = "full"
    cv: bool = False
    noise: Literal["independent", "averaged"] = "averaged"
    eps: float = 0.1
    schedule: str = "constant"
    start: Literal["mode", "prior"] = "mode"

    @property
    def label(self) -> str:
        if self.section == LONG:
            return f"{self.schedule}, from {self.start}"
        if self.whitening == "rmsprop":
            return f"{self.noise}, eps {self.eps:g}"
        return self.noise


def every_arm() -> list[Arm]:
    """The table's rows, section by section."""
    main, other = "step, batch, noise and control variates, whitened", "preconditioners"
    rows = [Arm(main, h, noise=n) for h, n in product((0.1, 0.3, 1.0, 1.5, 2.0), ("independent", "averaged"))]
    cross = product((0.1, 0.3, 1.0), (100, 32, 10), (False, True), ("independent", "averaged"))
    rows += [Arm(main, h, b, cv=cv, noise=n) for h, b, cv, n in cross]
    for kind in ("full", "diagonal", "none", "rmsprop"):
        noise = "independent" if kind == "rmsprop" else "averaged"
        base = Arm(other, 0.3, whitening=kind, noise=noise)
        rows += [base, replace(base, step=1.0)]
        rows += [replace(base, batch=100, cv=cv) for cv in (False, True)]
    rows.append(Arm(other, 0.3, whitening="rmsprop", noise="independent", eps=1e-5))
    base = Arm(LONG, 1.0, noise="independent")
    rows += [replace(base, start=s) for s in ("mode", "prior")]
    harmonic_rows = product((0.3, 1.0, 3.0), ("mode", "prior"))
    rows += [replace(base, step=h, schedule="eta_1/k", start=s) for h, s in harmonic_rows]
    slow = replace(base, schedule="(1+k/100)^-1/3")
    rows += [replace(slow, step=0.3), slow, replace(slow, start="prior")]
    rows += [replace(base, batch=32, schedule="eta_1/k"), replace(slow, step=0.1, batch=32)]
    return rows


@dataclass(frozen=True)
class Length:
    """Chains, steps dropped and steps kept."""

    chains: int
    burn_in: int
    steps: int


def length(arm: Arm, *, quick: bool) -> Length:
    """Full gradients: many chains. Minibatches, which all chains share: few chains, more steps."""
    if arm.section == LONG:
        return Length(8, 50, 950) if quick else Length(16, 1000, 19_000)
    full = Length(64, 150, 600) if arm.batch is None else Length(16, 300, 2400)
    return replace(full, steps=full.steps // 4) if quick else full


def settings(arm: Arm, size: Length) -> SamplerSettings:
    """The arm as settings of the sampler."""
    optimizer: Callable[[list[Tensor], float, torch.Generator | None], torch.optim.Optimizer] | None = None
    if arm.whitening == "rmsprop":

        def optimizer(params: list[Tensor], lr: float, generator: torch.Generator | None) -> SGLD:
            options = {"preconditioner": "rmsprop", "eps": arm.eps, "chain_dims": 2}
            return SGLD(params, lr, generator=generator, **options)

    return SamplerSettings(
        chains=size.chains,
        # the sampler limits slopes in its burn-in; here every step follows the law
        draws=size.burn_in + size.steps,
        burn_in=0,
        thinning=1,
        step=arm.step,
        noise=arm.noise,
        batch=arm.batch,
        spread=1.0 if arm.whitening == "rmsprop" else 0.0,
        schedule=SCHEDULES.get(arm.schedule),
        whitening=_space(arm),
        optimizer=optimizer,
    )


def _space(arm: Arm) -> Whitening:
    return "none" if arm.whitening == "rmsprop" else arm.whitening


def run(arm: Arm, problem: Problem, size: Length, *, seed: int = 1) -> Tensor:
    """Draws of ``z``, ``(chain, step, window, parameter)``, one a step."""
    density, mode = problem.density, problem.mode
    slowdown = stiffness(density, Coordinates.of(mode, _space(arm)))
    target = ControlVariates(density, mode) if arm.cv else density
    if arm.start == "prior":
        # coordinates are laid out from where chains start
        mode = Mode(density.prior.center().expand_as(mode.z), mode.scale, mode.log_prob, mode.converged)
    generator = torch.Generator().manual_seed(seed)
    return walk(target, mode, settings(arm, size), slowdown=slowdown, generator=generator)[:, size.burn_in :]


def predict(arm: Arm, problem: Problem, covariances: dict[bool, Tensor]) -> Tensor | None:
    """SD ratio by the closed form, ``(window, parameter)``; None for arms that have none."""
    if arm.whitening == "rmsprop" or arm.schedule != "constant" or arm.start == "prior":
        return None
    coordinates = Coordinates.of(problem.mode, _space(arm))
    coordinates = coordinates.slowed(stiffness(problem.density, coordinates))
    covariance = None if arm.batch is None else covariances[arm.cv] / arm.batch
    averaged = arm.noise == "averaged"
    return sd_ratio(problem, coordinates, arm.step, covariance, averaged=averaged, grows=arm.cv)
