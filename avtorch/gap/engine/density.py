r"""The posterior density of a hypothesis's coordinates, differentiable: samplers draw from it.

    log p(x | log) = temper log L(x) + log p(x) + const,    log L = -1/2 sum_b n_b log det E_b(x)

x are the coordinates that a fit moves (`Hypothesis.free`), the recorder's among them; L is that of `likelihood`, of the
torch plant behind the recorder, and p(x) is `evidence.log_prior`, with the non-local prior of sizes.
`temper` is the model average's. Tests hold the value to the compiled one and the gradient to differences.

Coordinates have limits. Samplers walk in z, which has none; the Jacobian is part of their density:

    x = low + s (softplus(z / s) - softplus((z - range) / s))

is z itself but within some `knee` s of a limit, so that what is normal stays normal. A recorder's delay has no limits
here; its z is the channel's lateness, delay plus filter, which a log knows far better than either.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import logsigmoid, one_hot, softplus

from avtorch.arrays import FloatArray
from avtorch.gap.engine.coordinates import INDEX
from avtorch.gap.engine.drive_data import DriveData
from avtorch.gap.engine.evidence import log_prior
from avtorch.gap.engine.hypothesis import Hypothesis
from avtorch.gap.engine.likelihood import LEAST
from avtorch.gap.engine.priors import TEMPER
from avtorch.gap.engine.torch_plant import SimulatorPlant, TorchPlant, recorded, torch_plant

_BLOCK = 2**18  # columns times steps of the grid at once: few enough for the processor's cache
_EDGE = 1e-3  # a start at a limit is moved inside by this share of the knee
_KNEE = 0.01  # of a coordinate's range, where none is given


@dataclass(frozen=True, eq=False)
class HypothesisDensity:
    """Log density of the free coordinates of a `hypothesis`: an `avtorch.inference.Density` of a single window.

    `chosen`: only these, the others are held; default all. `knee` (coordinate,): of the map between coordinates and z,
    best a posterior standard deviation. Where `not_in_torch` has a reason there is none.
    """

    hypothesis: Hypothesis
    temper: float = TEMPER
    chosen: tuple[str, ...] = ()
    knee: FloatArray | None = None

    windows = 1

    @property
    def names(self) -> tuple[str, ...]:
        return self.chosen or tuple(self.hypothesis.free)

    # in the coordinates -----------------------------------------------------------------------------------------------
    def log_density(self, x: Tensor) -> Tensor:
        """Log density (column,) of coordinates `x` (column, coordinate) within their limits [nats], by autograd."""
        prior = log_prior(self.hypothesis, self.names, x)
        return self.temper * log_likelihood(self.hypothesis.data, self.residual(x)) + prior

    def residual(self, x: Tensor) -> Tensor:
        """Measured less predicted coefficients, (column, channel, frame, bin)."""
        h = self.hypothesis
        values = {n: torch.tensor(h[n], dtype=x.dtype).expand(x.shape[:-1]) for n in h.free}
        values |= dict(zip(self.names, x.unbind(-1), strict=True))
        return torch.as_tensor(h.data.measured) - recorded(h.data, *self._plant.on_grid(values), values)

    def compiled(self, x: FloatArray) -> FloatArray:
        """`log_density` of `x` (column, coordinate) by the compiled plant: (column,), without derivatives, quicker."""
        h, at = self.hypothesis.copy(), [INDEX[n] for n in self.names]
        out = np.empty(len(x))
        for k, own in enumerate(x):
            h.values[at] = own
            h.evaluate()
            out[k] = h.log_likelihood
        return self.temper * out + log_prior(h, self.names, torch.as_tensor(x)).numpy()

    # as a density of z ------------------------------------------------------------------------------------------------
    def initial(self) -> Tensor:
        """z of the hypothesis's own values, (1, coordinate)."""
        values = torch.as_tensor(self.hypothesis.values[[INDEX[n] for n in self.names]])
        return self.unconstrain(values)[None]

    def constrain(self, z: Tensor) -> Tensor:
        """Coordinates of `z`, within their limits."""
        low, span, s = self._map
        x = torch.where(self._free, z, low + s * (_softplus(z / s) - _softplus((z - span) / s)))
        return x - x @ self._lateness

    def unconstrain(self, x: Tensor) -> Tensor:
        """`z` of coordinates; those at a limit are moved inside by a thousandth of the knee."""
        low, span, s = self._map
        y = torch.minimum((x - low).maximum(_EDGE * s), span - _EDGE * s)
        z = y + s * (torch.log(-torch.expm1(-y / s)) - torch.log(-torch.expm1((y - span) / s)))
        return torch.where(self._free, x + x @ self._lateness, z)

    def log_slope(self, z: Tensor) -> Tensor:
        """log dx/dz of each coordinate, the shape of `z`."""
        _, span, s = self._map
        slope = logsigmoid(z / s) + logsigmoid((span - z) / s) + torch.log(-torch.expm1(-span / s))
        return torch.where(self._free, 0.0, slope)

    @cached_property
    def _map(self) -> tuple[Tensor, Tensor, Tensor]:
        """Lower limit, range and knee of each coordinate."""
        limits = torch.tensor([self.hypothesis.limits(n) for n in self.names], dtype=torch.float64)
        span = limits[:, 1] - limits[:, 0]
        knee = _KNEE * span if self.knee is None else torch.minimum(torch.as_tensor(self.knee), 0.2 * span)
        return limits[:, 0], span, knee

    @cached_property
    def _free(self) -> Tensor:
        """Coordinates without limits."""
        return torch.tensor([not np.isfinite(support(self.hypothesis, n)).all() for n in self.names])

    @cached_property
    def _lateness(self) -> Tensor:
        """1 where a filter (row) belongs to the delay (column) of its channel."""
        names = self.names
        return torch.tensor(
            [[n == m.replace("_delay", "_filter") != m for m in names] for n in names], dtype=torch.float64
        )

    def log_prob(self, z: Tensor) -> Tensor:
        """Log density (..., 1) of `z` (..., 1, coordinate). Differentiable once."""
        return cast(Tensor, WithScore.apply(z, self))

    def score(self, z: Tensor) -> Tensor:
        """Gradient of `log_prob`, the shape of `z`."""
        return self.expand(z)[1]

    def expand(self, z: Tensor) -> tuple[Tensor, Tensor]:
        """Log density (..., 1) and its gradient (..., 1, coordinate); NaN where `z` is not finite."""
        values, scores = [], []
        for some in self._blocks(z):
            place = some.requires_grad_()
            with torch.enable_grad():
                near = place.nan_to_num(0.0, 0.0, 0.0)
                value = self.log_density(self.constrain(near)) + self.log_slope(near).sum(-1)
                (score,) = torch.autograd.grad(value.sum(), place)
            lost = ~place.detach().isfinite().all(-1)
            values.append(value.detach().masked_fill(lost, torch.nan))
            scores.append(score.masked_fill(lost[:, None], torch.nan))
        return torch.cat(values).reshape(z.shape[:-1]), torch.cat(scores).reshape(z.shape)

    def value(self, z: Tensor) -> Tensor:
        """`log_prob` by the compiled plant."""
        flat = z.detach().reshape(-1, z.shape[-1])
        value = torch.as_tensor(self.compiled(self.constrain(flat.nan_to_num(0.0)).numpy())) + self.log_slope(flat).sum(
            -1
        )
        return value.reshape(z.shape[:-1])

    # inside -----------------------------------------------------------------------------------------------------------
    @cached_property
    def _plant(self) -> TorchPlant | SimulatorPlant:
        return torch_plant(self.hypothesis)

    def _blocks(self, z: Tensor) -> Iterator[Tensor]:
        size = max(1, _BLOCK // len(self.hypothesis.data.grid.time))
        yield from z.detach().reshape(-1, z.shape[-1]).split(size)


def support(h: Hypothesis, name: str) -> tuple[float, float]:
    """Where a coordinate's density is not zero; limits of delays are a fit's only."""
    return (-math.inf, math.inf) if name in ("accel_delay", "speed_delay") else h.limits(name)


def log_likelihood(data: DriveData, residual: Tensor) -> Tensor:
    """`likelihood.log_likelihood` of residuals (column, channel, frame, bin): (column,) [nats]."""
    products = [(residual[..., i, :, :] * residual[..., j, :, :]).sum(-2) for i, j in pairs(data)]
    in_band = one_hot(torch.as_tensor(data.band_of_bin)).to(residual.dtype)
    return of_products(data, torch.stack(products, -2) @ in_band)


def pairs(data: DriveData) -> list[tuple[int, int]]:
    """Channels whose residuals' products the likelihood reads."""
    return [(0, 0)] if data.channel_count == 1 else [(0, 0), (0, 1), (1, 1)]


def of_products(data: DriveData, products: Tensor) -> Tensor:
    """Log likelihood (...) of the residuals' products (..., pair, band), sums over coefficients."""
    size = torch.as_tensor(data.band_size, dtype=products.dtype)
    S = products / size
    if data.channel_count == 1:
        det = (1 + LEAST) * S[..., 0, :]
    else:
        more = LEAST * (S[..., 0, :] + S[..., 2, :])
        det = (S[..., 0, :] + more) * (S[..., 2, :] + more) - S[..., 1, :] ** 2
    return -0.5 * (size * det.log()).sum(-1)


def _softplus(x: Tensor) -> Tensor:
    return softplus(x, threshold=40.0)  # linear only where doubles cannot tell


class WithScore(torch.autograd.Function):
    """A log density whose gradient is kept from the forward pass."""

    @staticmethod
    def forward(ctx: Any, z: Tensor, density: Any) -> Tensor:
        if not ctx.needs_input_grad[0]:
            return density.value(z)
        value, score = density.expand(z)
        ctx.save_for_backward(score)
        return value

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None]:  # pyright: ignore[reportIncompatibleMethodOverride]
        (score,) = ctx.saved_tensors
        return gradient[..., None] * score, None
