"""Step schedules of SGLD as ``torch.optim.lr_scheduler`` objects."""

from __future__ import annotations

from torch.optim import Optimizer
from torch.optim.lr_scheduler import LambdaLR

from avtorch.errors import InputError


def harmonic(optimizer: Optimizer) -> LambdaLR:
    """The paper's ``eta_k = eta_1 / k`` (Algorithm 1), ``k = 1, 2, ...``; ``eta_1`` is the optimizer's ``lr``.

    The sum of its steps grows only like ``log k``: the chain freezes long before it has explored the posterior. It is
    provided for comparison.
    """
    return LambdaLR(optimizer, lambda k: 1.0 / (k + 1))


def polynomial(optimizer: Optimizer, *, b: float = 100.0, gamma: float = 1 / 3) -> LambdaLR:
    """Welling and Teh's ``eta_k = a (b + k)^-gamma``, as ``lr (1 + k/b)^-gamma``: it starts at ``lr = a b^-gamma``.

    Raises:
        InputError: for ``b <= 0`` or ``gamma`` outside ``(0, 1]``.
    """
    if not b > 0:
        raise InputError(f"b: {b} is not positive")
    if not 0 < gamma <= 1:
        raise InputError(f"gamma: {gamma} is not in (0, 1]")
    return LambdaLR(optimizer, lambda k: (1 + k / b) ** -gamma)
