"""The exact, differentiable posterior density of a hypothesis's parameters.

Rollouts are differentiable in torch. Whitening is one fixed linear map `W` of long columns, so the gradient of `-|W e|²
/ 2` is `Wᵀ W e` propagated back through the rollout, with `Wᵀ` the same filter run backward in time.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import torch
from torch import Tensor

from avtorch.arrays import FloatArray
from avtorch.gap.likelihood.grade_marginal import GradeMarginal
from avtorch.gap.likelihood.hypothesis import Hypothesis
from avtorch.gap.likelihood.whitening_filter import WhiteningFilter, acting, sensed
from avtorch.gap.simulator.plant import GapPlant, plant
from avtorch.gap.simulator.rollout_from_onset import rollout_from_onset
from avtorch.inference.priors import LogSpaceNormal

if TYPE_CHECKING:
    from avtorch.gap.search.fitted_model import FittedModel


_FURTHEST = 10.0
"""The likelihood is constant beyond this number of prior standard deviations, so that rollouts stay finite."""
_BLOCK = 2**18
"""Columns times rows of one rollout: few enough to fit in the processor's cache."""


@dataclass(frozen=True, eq=False)
class RolloutDensity:
    """Log joint density of errors and coordinates `z`: an `avtorch.inference.Density` of a single window.

    A priori `z` is standard normal. The noise model is held, and so is the row `onset` from which the effects act
    (None: from the start). The coefficients and the size of the road grade are integrated out.
    """

    hypothesis: Hypothesis
    white: WhiteningFilter
    centre: FloatArray
    onset: int | None = None

    windows = 1

    @classmethod
    def of(cls, found: FittedModel) -> RolloutDensity:
        """The density with noise and onset of a fitted model."""
        return cls(found.hypothesis, found.white, np.asarray(found.z, float), found.onset)

    # the Density -----------------------------------------------------------------------------------------------------
    @property
    def names(self) -> tuple[str, ...]:
        return tuple(c.key for c in self.hypothesis.coordinates)

    @cached_property
    def prior(self) -> LogSpaceNormal:
        size = self.hypothesis.size
        return LogSpaceNormal(torch.zeros(1, size, dtype=torch.float64), torch.eye(size, dtype=torch.float64)[None])

    def select(self, index: Tensor) -> RolloutDensity:
        """The density itself, its only window."""
        return self

    def initial(self) -> Tensor:
        return torch.as_tensor(self.centre)[None]

    def constrain(self, z: Tensor) -> Tensor:
        """Values of the plant's parameters, each in its own unit."""
        each = zip(self.hypothesis.coordinates, z.unbind(-1), strict=True)
        return torch.stack([c.parameter.constrain(c.wider * x) for c, x in each], -1)

    def unconstrain(self, values: Tensor) -> Tensor:
        """`z` of parameter values."""
        each = zip(self.hypothesis.coordinates, values.unbind(-1), strict=True)
        return torch.stack([c.parameter.unconstrain(x) / c.wider for c, x in each], -1)

    def log_prob(self, z: Tensor) -> Tensor:
        """Log density (..., 1) of `z` (..., 1, coordinate). Differentiable once."""
        return cast(Tensor, _Exact.apply(z, self))

    def score(self, z: Tensor) -> Tensor:
        """Gradient of `log_prob`, the shape of `z`."""
        return self.expand(z)[1]

    def expand(self, z: Tensor) -> tuple[Tensor, Tensor]:
        """Log density (..., 1) and its gradient (..., 1, coordinate)."""
        values, scores = [], []
        for some in self._blocks(z):
            place = some.requires_grad_()
            with torch.enable_grad():
                rolled = self._rolled(place)
                value, cotangent = self._log_likelihood(rolled.detach().numpy(), slope=True)
                (score,) = torch.autograd.grad(rolled, place, torch.as_tensor(cotangent))
            place = place.detach()  # NaN where a chain diverged, so that its sampler can detect it
            values.append(torch.as_tensor(value))
            scores.append(score - place)
        return torch.cat(values).reshape(z.shape[:-1]) + self._prior(z), torch.cat(scores).reshape(z.shape)

    def value(self, z: Tensor) -> Tensor:
        """`log_prob` without a graph."""
        with torch.inference_mode():  # no derivatives: faster recursions
            values = [self._log_likelihood(self._rolled(b).numpy())[0] for b in self._blocks(z)]
        return torch.as_tensor(np.concatenate(values)).reshape(z.shape[:-1]) + self._prior(z)

    # parts of the density --------------------------------------------------------------------------------------------
    def images(self, z: Tensor) -> FloatArray:
        """Whitened errors (column, row) for `z` (column, coordinate)."""
        with torch.inference_mode():
            return np.concatenate([self._image(self._errors(self._rolled(b).numpy())) for b in self._blocks(z)])

    @cached_property
    def constant(self) -> float:
        """The term of the log likelihood that does not depend on the errors."""
        return self.white.constant_of(coarse=False)

    @cached_property
    def slope(self) -> GradeMarginal | None:
        """The marginal of the road grade; None where the hypothesis has none."""
        columns = self.hypothesis.grade_columns
        if columns is None:
            return None
        columns = acting(self.white.record, columns, self.onset)
        return GradeMarginal.of(self._image(sensed(self.white.record, self.white.noise, columns)))

    def _prior(self, z: Tensor) -> Tensor:
        return -0.5 * z.square().sum(-1)

    def _blocks(self, z: Tensor) -> tuple[Tensor, ...]:
        size = max(1, _BLOCK // sum(len(d.time) for d in self.hypothesis.record.drives))
        return z.detach().reshape(-1, z.shape[-1]).split(size)

    @cached_property
    def _without(self) -> GapPlant:
        return plant([], baseline=self.hypothesis.baseline)

    def _rolled(self, z: Tensor) -> Tensor:
        """Rollouts of the channels, (column, channel, counted, group)."""
        keys = self.names
        near = z.nan_to_num(0.0).clamp(-_FURTHEST, _FURTHEST)
        if self.onset is None:
            near = near * torch.tensor([not c.parameter.of_onset for c in self.hypothesis.coordinates])
        values = dict(zip(keys, self.constrain(near).unbind(-1), strict=True))
        record, whole = self.hypothesis.record, self.hypothesis.plant
        if self.onset is None:
            responses = [whole.response(drive, values) for drive in record.drives]
        else:
            responses = rollout_from_onset(whole, self._without, record.drives, values, record.place(self.onset))
        channels = {"accel": [r.accel_measured for r in responses], "speed": [r.speed for r in responses]}
        source, columns = torch.as_tensor(record.source), len(values["T_L"])
        parts = []
        for name in record.channels:
            whole = torch.cat([x.unflatten(-1, (-1, record.group)) for x in channels[name]], -2)
            part = whole if len(source) == whole.shape[-2] else whole.index_select(-2, source)
            parts.append(part.expand(columns, *part.shape[-2:]))
        return torch.stack(parts, 1)

    def _errors(self, rolled: FloatArray) -> FloatArray:
        return self.hypothesis.record.measured - rolled

    def _image(self, errors: FloatArray) -> FloatArray:
        """Whitened errors, every row once: (column, row)."""
        return self.white(errors).reshape(len(errors), -1)

    def _log_likelihood(self, rolled: FloatArray, *, slope: bool = False) -> tuple[FloatArray, FloatArray | None]:
        """Log likelihood (column,) of rollouts and, with `slope`, its derivative by the rollouts."""
        errors = self._errors(rolled)
        flat = self._image(errors)
        value = self.constant - 0.5 * np.einsum("cr,cr->c", flat, flat)
        if self.slope is not None:
            gained, less = self.slope.gained(flat)
            value, flat = value + gained, flat - less
        if not slope:
            return value, None
        return value, self.white.transpose(flat.reshape(errors.shape))


class _Exact(torch.autograd.Function):
    """The log density, its gradient kept from the forward pass."""

    @staticmethod
    def forward(ctx: Any, z: Tensor, density: RolloutDensity) -> Tensor:
        if not ctx.needs_input_grad[0]:
            return density.value(z)
        value, score = density.expand(z)
        ctx.save_for_backward(score)
        return value

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None]:  # pyright: ignore[reportIncompatibleMethodOverride]
        (score,) = ctx.saved_tensors
        return gradient[..., None] * score, None


def root(covariance: FloatArray) -> Tensor:
    """A lower triangular root of a covariance, valid also where round-off made it indefinite."""
    values, vectors = np.linalg.eigh(0.5 * (covariance + covariance.T))
    half = vectors * np.sqrt(np.maximum(values, 1e-14))
    lower = torch.linalg.qr(torch.as_tensor(half.T.copy())).R.mT
    return lower * torch.sign(lower.diagonal())
