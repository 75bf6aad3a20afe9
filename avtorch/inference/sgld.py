r"""Stochastic gradient Langevin dynamics (Welling & Teh 2011; paper, Sec. 3.2) as a ``torch.optim`` optimizer."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from typing import Any, Literal, cast

import torch
from torch import Tensor
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LambdaLR

from avtorch.arrays import Float
from avtorch.errors import InputError

Noise = Literal["independent", "averaged"]

# torch.optim's own way to the fused arithmetic
_add_to_each = torch._foreach_add_  # pyright: ignore[reportPrivateImportUsage, reportPrivateUsage]


class SGLD(Optimizer):
    r"""Samples from :math:`\exp(-U)` by noisy gradient steps.

    .. math::
        \theta \leftarrow \theta - \tfrac{h}{2} \nabla U(\theta) + \sqrt{h\,\mathcal T}\;\xi, \qquad \xi \sim N(0, I)

    ``U`` is the potential: the negative log density **on the scale of the whole window**. A closure that works on a
    minibatch returns ``-log p(theta) - (N/n) sum_batch log p(D_i | theta)``; a mean over points would shrink the drift
    but not the noise. (The paper's equation for SGLD misplaces ``N/n``, loses the sign and applies the step twice; this
    is the law of Welling and Teh.) With ``temperature=0`` no noise is drawn and the step is that of SGD with ``lr =
    h/2``. On a Gaussian of precision ``p`` with gradient-noise variance ``s2`` the stationary variance is ``(1 + h
    s2/4) / (p (1 - h p/4))``.

    Chains and windows are leading dimensions of the parameters: one step moves all of them, and ``U`` may then be a
    tensor with one entry per chain and window (their sum is differentiated).

    Args:
        params: tensors or parameter groups.
        lr: the step ``h`` (the paper's ``eta``); any ``torch.optim.lr_scheduler`` may change it.
        temperature: scales the noise's variance; 1 samples the density, 0 descends to its mode.
        noise: ``"independent"`` is the law above; ``"averaged"`` replaces ``xi_k`` by ``(xi_k + xi_{k+1})/2``
            (Leimkuhler & Matthews 2013): no bias in the variance of a Gaussian, order ``h^2`` elsewhere.
        preconditioner: ``None``, or ``"rmsprop"``: pSGLD (Li et al. 2016), ``G = 1/(eps + sqrt(V))`` with ``V`` the
            running mean square of the gradient, *with* the curvature term ``Gamma = dG/dtheta``. It needs second
            derivatives, so the closure must return ``U`` without calling ``backward``.
        alpha: memory of ``V``.
        eps: floor of ``sqrt(V)``.
        noise_dtype: dtype in which the noise is drawn, by default that of the parameter. ``torch.float32`` takes a
            fifth of the time of ``float64``; its normal numbers are cut off at about 5.7 SDs.
        chain_dims: how many leading dimensions of each parameter hold independent terms of ``U`` (chains, windows);
            ``Gamma`` then costs one derivative per remaining entry. Used by the preconditioner only.
        maximize: the closure returns a log density instead of a potential.
        foreach: use the fused multi-tensor arithmetic; the draws and the result's law are the same.
        generator: source of the noise. Its state is part of ``state_dict``, which makes a resumed run equal bit for
            bit.

    Raises `InputError` naming the argument that is out of range.

    Example:
        >>> import torch
        >>> from avtorch import SGLD
        >>> theta = torch.zeros(1000, requires_grad=True)  # a thousand chains
        >>> sampler = SGLD([theta], lr=0.2, generator=torch.Generator().manual_seed(0))
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
        temperature: float = 1.0,
        noise: Noise = "independent",
        preconditioner: Literal["rmsprop"] | None = None,
        alpha: float = 0.99,
        eps: float = 1e-5,
        noise_dtype: torch.dtype | None = None,
        chain_dims: int = 0,
        maximize: bool = False,
        foreach: bool = False,
        generator: torch.Generator | None = None,
    ) -> None:
        defaults: dict[str, Any] = {
            "lr": lr,
            "temperature": temperature,
            "noise": noise,
            "preconditioner": preconditioner,
            "alpha": alpha,
            "eps": eps,
            "noise_dtype": noise_dtype,
            "chain_dims": chain_dims,
            "maximize": maximize,
            "foreach": foreach,
        }
        self.check(defaults)
        self.generator = generator
        super().__init__(params, defaults)

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

    def normal_like(self, p: Float[Tensor, "*parameter"], dtype: torch.dtype | None) -> Float[Tensor, "*parameter"]:
        """Standard normal noise in the shape of ``p`` and, for arithmetic in one sweep, in its order in memory."""
        order = sorted(range(p.dim()), key=p.stride, reverse=True)
        shape = [p.shape[i] for i in order]
        drawn = torch.randn(shape, dtype=dtype or p.dtype, device=p.device, generator=self.generator)
        return drawn.permute([order.index(i) for i in range(p.dim())])

    @staticmethod
    def check(options: dict[str, Any]) -> None:
        """Refuse a bad option by its name; raises InputError."""

        def positive(name: str, low: float, high: float, *, closed: bool = False) -> None:
            value = float(options[name])
            if not ((low <= value if closed else low < value) and value < high):
                raise InputError(f"{name}: {options[name]!r} is not in {'[' if closed else '('}{low:g}, {high:g})")

        positive("lr", 0, math.inf, closed=True)
        positive("temperature", 0, math.inf, closed=True)
        positive("alpha", 0, 1, closed=True)
        positive("eps", 0, math.inf)
        if options["noise"] not in ("independent", "averaged"):
            raise InputError(f"noise: {options['noise']!r} is neither 'independent' nor 'averaged'")
        if options["preconditioner"] not in (None, "rmsprop"):
            raise InputError(f"preconditioner: {options['preconditioner']!r} is neither None nor 'rmsprop'")
        if options["chain_dims"] < 0:
            raise InputError(f"chain_dims: {options['chain_dims']!r} is negative")

    @torch.no_grad()
    def step(self, closure: Callable[[], Any] | None = None) -> Any:  # pyright: ignore[reportIncompatibleMethodOverride]
        """One step. ``closure`` returns the potential ``U``; it may call ``backward`` itself or leave that to the step.

        Returns:
            What the closure returned.
        """
        parameters = [p for group in self.param_groups for p in group["params"]]
        potential, curvature = None, None
        if closure is not None:
            potential, curvature = self._differentiate(closure, parameters)
        elif any(group["preconditioner"] for group in self.param_groups):
            raise InputError("closure: needed by preconditioner='rmsprop', whose Gamma term differentiates U twice")
        for group in self.param_groups:
            active = [p for p in group["params"] if p.grad is not None]
            if active:
                self._update(group, active, curvature)
        return potential

    def _differentiate(
        self, closure: Callable[[], Any], parameters: list[Tensor]
    ) -> tuple[Any, dict[Tensor, Tensor] | None]:
        """Run the closure, leave ``dU/dtheta`` in ``.grad``; also the Hessian's diagonal where a group needs it."""
        for p in parameters:
            p.grad = None
        with torch.enable_grad():
            potential = closure()
            if any(p.grad is not None for p in parameters):
                if any(group["preconditioner"] for group in self.param_groups):
                    raise InputError("closure: must return U without calling backward when preconditioner='rmsprop'")
                return potential, None
            wanted = [p for p in parameters if p.requires_grad]
            twice = any(group["preconditioner"] for group in self.param_groups)
            # torch's types leave out the None of what is unused
            gradients = cast(
                "tuple[Tensor | None, ...]",
                torch.autograd.grad(potential.sum(), wanted, create_graph=twice, allow_unused=True),
            )
            curvature = None
            if twice:
                dims = {p: group["chain_dims"] for group in self.param_groups for p in group["params"]}
                pairs = [(p, g) for p, g in zip(wanted, gradients, strict=True) if g is not None]
                curvature = {p: _hessian_diagonal(p, g, dims[p]) for p, g in pairs}
        for p, gradient in zip(wanted, gradients, strict=True):
            p.grad = None if gradient is None else gradient.detach()
        return potential, curvature

    def _update(self, group: dict[str, Any], params: list[Tensor], curvature: dict[Tensor, Tensor] | None) -> None:
        h, sign = group["lr"], (-1.0 if group["maximize"] else 1.0)
        amplitude = math.sqrt(h * group["temperature"])
        drifts = [cast(Tensor, p.grad) for p in params]
        noises = [self._noise(p, group["noise"], group["noise_dtype"]) for p in params] if amplitude > 0 else None
        if group["preconditioner"] == "rmsprop":
            assert curvature is not None
            for i, p in enumerate(params):
                scale, gamma = self._precondition(p, drifts[i], curvature[p], group)
                # the law is that of U at unit temperature scaled by T, hence T in front of Gamma
                drifts[i] = scale * drifts[i] - sign * group["temperature"] * gamma
                if noises is not None:
                    noises[i] = noises[i] * scale.sqrt()
        if group["foreach"]:
            _add_to_each(params, drifts, alpha=-0.5 * h * sign)
            if noises is not None:
                _add_to_each(params, noises, alpha=amplitude)
            return
        for i, p in enumerate(params):
            p.add_(drifts[i], alpha=-0.5 * h * sign)
            if noises is not None:
                p.add_(noises[i], alpha=amplitude)

    def _noise(self, p: Tensor, kind: Noise, dtype: torch.dtype | None) -> Tensor:
        fresh = self.normal_like(p, dtype)
        if kind == "independent":
            return fresh
        previous = self.state[p].get("noise")
        if previous is None:
            previous = self.normal_like(p, dtype)
        self.state[p]["noise"] = fresh
        # a restored state comes in the dtype of p
        return (previous.to(fresh.dtype) + fresh).mul_(0.5)

    def _precondition(
        self, p: Tensor, gradient: Tensor, curvature: Tensor, group: dict[str, Any]
    ) -> tuple[Tensor, Tensor]:
        """``G`` and ``Gamma = dG/dtheta`` (Li et al. 2016).

        ``dV/dtheta = 2 (1 - alpha) g H_ii`` and ``dG/dV = -G^2/(2 sqrt V)``.
        """
        alpha = group["alpha"]
        state = self.state[p]
        mean_square = state.get("mean_square")
        # started at the first squared gradient: from zero the first steps would be thousands of times too long
        mean_square = (
            gradient.square() if mean_square is None else alpha * mean_square + (1 - alpha) * gradient.square()
        )
        state["mean_square"] = mean_square
        root = mean_square.sqrt()
        scale = 1 / (group["eps"] + root)
        # |gradient| sqrt(1 - alpha) <= root, so the quotient is bounded and needs a floor only against 0/0
        quotient = gradient / root.clamp_min(torch.finfo(root.dtype).tiny)
        gamma = -scale.square() * (1 - alpha) * quotient * curvature
        return scale, gamma


def _hessian_diagonal(p: Tensor, gradient: Tensor, chain_dims: int) -> Tensor:
    """Diagonal of the Hessian, one derivative per entry behind the ``chain_dims`` independent leading dimensions."""
    if not gradient.requires_grad:  # U is linear
        return torch.zeros_like(p)
    flat = gradient.flatten(chain_dims) if p.dim() > chain_dims else gradient.unsqueeze(-1)
    columns: list[Tensor] = []
    for i in range(flat.shape[-1]):
        (derivative,) = cast(
            "tuple[Tensor | None]",  # None where U does not depend on it, which torch's types leave out
            torch.autograd.grad(flat[..., i].sum(), p, retain_graph=True, allow_unused=True),
        )
        row = torch.zeros_like(p) if derivative is None else derivative
        columns.append((row.flatten(chain_dims) if p.dim() > chain_dims else row.unsqueeze(-1))[..., i])
    return torch.stack(columns, -1).reshape(p.shape)


def harmonic(optimizer: Optimizer) -> LambdaLR:
    """The paper's ``eta_k = eta_1 / k`` (Algorithm 1), ``k = 1, 2, ...``; ``eta_1`` is the optimizer's ``lr``.

    The sum of its steps grows only like ``log k``: the chain freezes long before it has explored the posterior. It is
    provided for comparison.
    """
    return LambdaLR(optimizer, lambda k: 1.0 / (k + 1))


def polynomial(optimizer: Optimizer, *, b: float = 100.0, gamma: float = 1 / 3) -> LambdaLR:
    """Welling and Teh's ``eta_k = a (b + k)^-gamma``, as ``lr (1 + k/b)^-gamma``: it starts at ``lr = a b^-gamma``.

    Raises `InputError` for ``b <= 0`` or ``gamma`` outside ``(0, 1]``.
    """
    if not b > 0:
        raise InputError(f"b: {b} is not positive")
    if not 0 < gamma <= 1:
        raise InputError(f"gamma: {gamma} is not in (0, 1]")
    return LambdaLR(optimizer, lambda k: (1 + k / b) ** -gamma)
