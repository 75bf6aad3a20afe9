r"""Stochastic gradient Hamiltonian Monte Carlo (Chen, Fox & Guestrin 2014) as a ``torch.optim`` optimizer."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from typing import Any, cast

import torch
from torch import Tensor

from avtorch.errors import InputError
from avtorch.inference.langevin import LangevinOptimizer


class SGHMC(LangevinOptimizer):
    r"""Samples from :math:`\exp(-U)` by gradient steps with a momentum that friction damps and noise drives.

    With :math:`\varepsilon = \sqrt h` and :math:`c = e^{-\gamma\varepsilon}` one step is

    .. math::
        v &\leftarrow v - \varepsilon \nabla U(\theta) \\
        \theta &\leftarrow \theta + \tfrac{\varepsilon}{2} v \\
        v &\leftarrow c\,v + \sqrt{(1 - c^2)\,\mathcal T}\;\xi, \qquad \xi \sim N(0, I) \\
        \theta &\leftarrow \theta + \tfrac{\varepsilon}{2} v

    ``U`` is the potential: the negative log density **on the scale of the whole window**. A closure that works on a
    minibatch returns ``-log p(theta) - (N/n) sum_batch log p(D_i | theta)``. The order of the parts is BAOAB
    (Leimkuhler & Matthews 2013), one gradient a step; Chen et al. take Euler's, whose stationary law is off in first
    order of ``eps``. The velocity ``v`` has unit mass and starts as ``N(0, temperature)``.

    The step ``h`` is that of :class:`SGLD`: at ``friction=inf`` (``c = 0``) this is SGLD with averaged noise. On a
    Gaussian of precision ``p`` with gradient-noise variance ``s2`` the stationary variance at unit temperature is
    ``(1 + h s2 (1 + c) / (4 (1 - c) (1 - h p/4))) / p``: exact for full gradients, while momentum gathers the noise of
    minibatches (no estimate of it is subtracted, Chen et al.'s ``B = 0``). Stable for ``h p < 4``. With
    ``temperature=0`` the step is that of SGD with ``momentum=c`` and ``lr = h (1 + c)/2``.

    Args:
        params: tensors or parameter groups; chains and windows are leading dimensions.
        lr: the step ``h``, the square of the time step ``eps``; any ``torch.optim.lr_scheduler`` may change it.
        friction: ``gamma``, per unit of time; 2 damps a direction of unit precision critically.
        temperature: scales the noise's variance; 1 samples the density, 0 descends to its mode.
        maximize: the closure returns a log density instead of a potential.
        foreach: use the fused multi-tensor arithmetic; the draws and the result's law are the same.
        generator: source of the noise. Its state is part of ``state_dict``, which makes a resumed run equal bit for
            bit.

    Raises:
        InputError: naming the argument that is out of range.

    Example:
        >>> import torch
        >>> from avtorch.inference import SGHMC
        >>> theta = torch.zeros(1000, requires_grad=True)  # a thousand chains
        >>> sampler = SGHMC([theta], lr=0.2, generator=torch.Generator().manual_seed(0))
        >>> for _ in range(100):
        ...     potential = sampler.step(lambda: ((theta - 2) ** 2 / 2).sum())  # of Normal(2, 1)
        >>> round(theta.mean().item(), 1), round(theta.std().item(), 1)
        (2.0, 1.0)
    """

    def __init__(
        self,
        params: Iterable[Any],
        lr: float,
        *,
        friction: float = 2.0,
        temperature: float = 1.0,
        maximize: bool = False,
        foreach: bool = False,
        generator: torch.Generator | None = None,
    ) -> None:
        defaults: dict[str, Any] = {
            "lr": lr,
            "friction": friction,
            "temperature": temperature,
            "maximize": maximize,
            "foreach": foreach,
        }
        super().__init__(params, defaults, generator)

    @staticmethod
    def check(options: dict[str, Any]) -> None:
        for name in ("lr", "temperature"):
            if not 0 <= float(options[name]) < math.inf:
                raise InputError(f"{name}: {options[name]!r} is not in [0, inf)")
        if not 0 < float(options["friction"]) <= math.inf:
            raise InputError(f"friction: {options['friction']!r} is not in (0, inf]")

    @torch.no_grad()
    def step(self, closure: Callable[[], Any] | None = None) -> Any:  # pyright: ignore[reportIncompatibleMethodOverride]
        """One step. ``closure`` returns the potential ``U``; it may call ``backward`` itself or leave that to the step.

        Returns:
            What the closure returned.
        """
        potential = None if closure is None else self.differentiate(closure)
        for group in self.param_groups:
            active = [p for p in group["params"] if p.grad is not None]
            if active:
                self._update(group, active)
        return potential

    def _update(self, group: dict[str, Any], params: list[Tensor]) -> None:
        eps, sign = math.sqrt(group["lr"]), (-1.0 if group["maximize"] else 1.0)
        # a step of zero length moves nothing, for any friction
        kept = math.exp(-group["friction"] * eps) if eps > 0 else 1.0
        amplitude = math.sqrt((1 - kept**2) * group["temperature"])
        velocities = [self._velocity(p, group["temperature"]) for p in params]
        gradients = [cast(Tensor, p.grad) for p in params]
        noises = [self.normal_like(p) for p in params] if amplitude > 0 else None
        # a new velocity each step: the old one may lie in a saved state
        if group["foreach"]:
            velocities = torch._foreach_add(velocities, gradients, alpha=-eps * sign)  # pyright: ignore
            torch._foreach_add_(params, velocities, alpha=0.5 * eps)  # pyright: ignore
            torch._foreach_mul_(velocities, kept)  # pyright: ignore
            if noises is not None:
                torch._foreach_add_(velocities, noises, alpha=amplitude)  # pyright: ignore
            torch._foreach_add_(params, velocities, alpha=0.5 * eps)  # pyright: ignore
        else:
            velocities = [v.add(g, alpha=-eps * sign) for v, g in zip(velocities, gradients, strict=True)]
            for i, (p, v) in enumerate(zip(params, velocities, strict=True)):
                p.add_(v, alpha=0.5 * eps)
                v.mul_(kept)
                if noises is not None:
                    v.add_(noises[i], alpha=amplitude)
                p.add_(v, alpha=0.5 * eps)
        for p, v in zip(params, velocities, strict=True):
            self.state[p]["velocity"] = v

    def _velocity(self, p: Tensor, temperature: float) -> Tensor:
        kept = self.state[p].get("velocity")
        if kept is not None:
            return kept
        return math.sqrt(temperature) * self.normal_like(p) if temperature > 0 else torch.zeros_like(p)
