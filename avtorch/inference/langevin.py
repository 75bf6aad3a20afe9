"""What every Langevin optimizer shares: a generator that resumes bit for bit, checked groups, closures that return
U."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import torch
from torch import Tensor
from torch.optim import Optimizer

from avtorch.arrays import Float


class LangevinOptimizer(Optimizer):
    """A ``torch.optim`` optimizer that draws its noise from ``generator``, whose state is part of ``state_dict``."""

    def __init__(self, params: Iterable[Any], defaults: dict[str, Any], generator: torch.Generator | None) -> None:
        self.check(defaults)
        self.generator = generator
        super().__init__(params, defaults)

    @staticmethod
    def check(options: dict[str, Any]) -> None:
        """Refuse a bad option by its name; raises InputError."""

    def add_param_group(self, param_group: dict[str, Any]) -> None:
        self.check({**self.defaults, **param_group})
        super().add_param_group(param_group)

    def __getstate__(self) -> dict[str, Any]:
        return {**super().__getstate__(), "generator": self.generator}

    def __setstate__(self, state: dict[str, Any]) -> None:
        super().__setstate__(state)
        for group in self.param_groups:
            for key, value in self.defaults.items():
                group.setdefault(key, value)

    def state_dict(self) -> dict[str, Any]:
        """As in ``torch.optim``, with the generator's state beside it."""
        state = super().state_dict()
        if self.generator is not None:
            state["generator"] = self.generator.get_state()
        return state

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        state = dict(state_dict)
        generator = state.pop("generator", None)
        super().load_state_dict(state)
        if generator is not None:
            if self.generator is None:
                self.generator = torch.Generator(device=self.param_groups[0]["params"][0].device)
            self.generator.set_state(generator)

    def normal_like(
        self, p: Float[Tensor, "*parameter"], dtype: torch.dtype | None = None
    ) -> Float[Tensor, "*parameter"]:
        """Standard normal noise in the shape of ``p`` and, for arithmetic in one sweep, in its order in memory."""
        order = sorted(range(p.dim()), key=p.stride, reverse=True)
        shape = [p.shape[i] for i in order]
        drawn = torch.randn(shape, dtype=dtype or p.dtype, device=p.device, generator=self.generator)
        return drawn.permute([order.index(i) for i in range(p.dim())])

    def differentiate(self, closure: Callable[[], Any]) -> Any:
        """Run the closure under ``enable_grad`` and leave ``dU/dtheta`` in ``.grad``; returns what it returned.

        The closure returns ``U``, a number or a tensor to be summed, or calls ``backward`` itself.
        """
        parameters = [p for group in self.param_groups for p in group["params"]]
        for p in parameters:
            p.grad = None
        with torch.enable_grad():
            potential = closure()
            if all(p.grad is None for p in parameters):
                wanted = [p for p in parameters if p.requires_grad]
                gradients = torch.autograd.grad(potential.sum(), wanted, allow_unused=True)
                for p, gradient in zip(wanted, gradients, strict=True):
                    p.grad = gradient
        return potential
