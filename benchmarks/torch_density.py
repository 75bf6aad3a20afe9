"""Any log density written in torch as a target of the sampler: posteriors that have nothing to do with vehicles."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import torch
from torch import Tensor
from torch.distributions import biject_to
from torch.distributions.constraints import Constraint

from avtorch.arrays import Float
from avtorch.errors import InputError
from avtorch.inference.device import Device, checked_device

LogDensity = Callable[[dict[str, Tensor]], Tensor]


class TorchDensity:
    """A posterior over scalar parameters, each with its constraint, given as a function of them.

    The parameters are sampled in an unconstrained space by PyTorch's own bijections (``log`` for positive ones). Their
    Jacobian is included here and must not be in ``log_density``.

    Args:
        log_density: from a dict of named tensors ``(...)`` to the log density ``(...)``, up to a constant; it must be
            differentiable and take any leading shape.
        parameters: names and their ``torch.distributions.constraints``, of one real number each.
        start: where the search for the mode begins, in the parameters' own units; where their bijections map 0 by
            default.
        device: where ``log_density`` computes.

    Raises `InputError` for no parameters, a constraint that is not of a single number, a start that breaks one, or a
    device that this machine lacks.
    """

    windows = 1

    def __init__(
        self,
        log_density: LogDensity,
        parameters: Mapping[str, Constraint],
        *,
        start: Mapping[str, float] | None = None,
        device: Device = "cpu",
    ) -> None:
        if not parameters:
            raise InputError("parameters: none named, need one or more")
        self.names = tuple(parameters)
        self.log_density = log_density
        self._maps = []
        for name, constraint in parameters.items():
            if constraint.event_dim != 0 or constraint.is_discrete:
                raise InputError(f"parameters: the constraint of {name} is {constraint}, need that of one real number")
            self._maps.append(biject_to(constraint))
        z = []
        for name, to_constrained in zip(self.names, self._maps, strict=True):
            value = torch.zeros((), dtype=torch.float64)
            if start is not None:
                if name not in start:
                    raise InputError(f"start: {name} is missing")
                given = torch.tensor(float(start[name]), dtype=torch.float64)
                if not bool(parameters[name].check(given)):
                    raise InputError(f"start: {name} = {float(given):g} breaks its constraint {parameters[name]}")
                value = to_constrained.inv(given)
            z.append(value)
        self._start = torch.stack(z)[None].to(checked_device(device))

    def constrain(self, z: Float[Tensor, "*draw parameter"]) -> Float[Tensor, "*draw parameter"]:
        """Parameters in their own units, shape of ``z``."""
        return torch.stack([t(x) for t, x in zip(self._maps, z.unbind(-1), strict=True)], -1)

    def log_prob(self, z: Float[Tensor, "*draw 1 parameter"]) -> Float[Tensor, "*draw 1"]:
        """Log density of ``z`` ``(..., 1, parameter)``, Jacobian included; returns ``(..., 1)``, NaN where ``z`` is."""
        # torch's distributions raise at the first NaN: one chain that diverges must not end the others
        lost = z.isnan().any(-1)
        free = torch.where(lost[..., None], z.new_zeros(()), z).unbind(-1)
        values = [t(x) for t, x in zip(self._maps, free, strict=True)]
        log_density = self.log_density(dict(zip(self.names, values, strict=True)))
        for t, x, y in zip(self._maps, free, values, strict=True):
            log_density = log_density + t.log_abs_det_jacobian(x, y)
        return torch.where(lost, torch.nan, log_density)

    def initial(self) -> Float[Tensor, "1 parameter"]:
        """``(1, parameter)``."""
        return self._start
