"""Values of the latent log likelihood on uneven rows, without a graph: the row-by-row filter for many parameters at
once.

`latent_filter` is the same recursion with a graph. Mean and covariance are kept side by side in one matrix, so that a
row takes some twenty calls for all parameters together. Step matrices are smooth functions of the step's length: where
a clock jitters, they are interpolated between Chebyshev nodes instead of computed for every row, to round-off.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from avtorch.arrays import Float
from avtorch.inference.latent_model import discretise, initial_covariance

Array = NDArray[Any]
Six = tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]

ROUND_OFF = 1e-13
"""Relative error allowed to an interpolated step: that of the matrices' own arithmetic."""
_MOST_NODES = 24
# rows whose matrices are made together: enough to make the calls cheap, few enough for the memory
_ROWS = 64
_SPEED, _ACCEL = (0, 2), (1, 3)


@torch.no_grad()
def row_values(
    T_L: Float[Tensor, " draw"],
    K_L: Float[Tensor, " draw"],
    process_noise: Float[Tensor, " draw"],
    coloured_sd: Float[Tensor, " draw"],
    coloured_time: Float[Tensor, " draw"],
    time: Float[Tensor, " row"],
    u: Float[Tensor, " row"],
    *,
    accel: Float[Tensor, "#draw row"] | None = None,
    speed: Float[Tensor, "#draw row"] | None = None,
    accel_noise: Float[Tensor, " draw"] | None = None,
    speed_noise: Float[Tensor, " draw"] | None = None,
    road_noise: Float[Tensor, " draw"] | None = None,
) -> Float[Tensor, " draw"]:
    """Log likelihood ``(draw,)`` [nats] of one run of rows in use, as `latent_log_likelihood`, with no gradient.

    Signals are ``(draw, row)``, or ``(1, row)`` for the same rows under all parameters. NaN where digits are lost.
    """
    road = torch.zeros_like(T_L) if road_noise is None else road_noise
    parameters = (T_L, K_L, process_noise, road, coloured_sd, coloured_time)
    channels = []
    if speed is not None and speed_noise is not None:
        # the deviation from the first measured speed, whose prior mean is thereby zero
        channels.append((_SPEED, (speed - speed[:, :1]).numpy(), speed_noise.square().numpy()))
    if accel is not None and accel_noise is not None:
        channels.append((_ACCEL, accel.numpy(), accel_noise.square().numpy()))
    rows, draws = len(time), len(T_L)
    # covariance, and the mean as its fifth column
    X = np.zeros((draws, 4, 5))
    X[..., :4] = initial_covariance(coloured_sd, coloured_time).numpy()
    spread, missed = np.empty((2, rows, len(channels), draws))
    steps = time.diff()
    command = u.numpy()
    nodes, weights = _nodes(parameters, steps)
    table = None if nodes is None else _discretised(parameters, nodes)
    with np.errstate(all="ignore"):
        for first in range(0, rows, _ROWS):
            count = min(_ROWS, rows - first)
            block = slice(first, min(first + count, rows - 1))
            matrices = _discretised(parameters, steps[block]) if table is None else _interpolated(table, weights[block])
            for k in range(first, first + count):
                for c, ((i, j), data, variance) in enumerate(channels):
                    seen = X[:, i] + X[:, j]
                    S = seen[:, i] + seen[:, j] + variance
                    seen[:, 4] -= data[:, k]
                    gain = seen[:, :4] / S[:, None]
                    spread[k, c], missed[k, c] = S, seen[:, 4]
                    X -= gain[:, :, None] * seen[:, None, :]
                if k + 1 < rows:
                    F, B, Q = (x[k - first] for x in matrices)
                    X = F @ X
                    X[..., :4] = X[..., :4] @ F.swapaxes(1, 2) + Q
                    X[..., 4] += B * command[k]
        total = np.log(spread) + missed**2 / spread
    return torch.from_numpy(-0.5 * (total.sum((0, 1)) + rows * len(channels) * math.log(2.0 * math.pi)))


def _nodes(parameters: Six, steps: Tensor) -> tuple[Tensor | None, Array]:
    """Chebyshev nodes (node,) of the steps' lengths and their weights (row, node); None where all rows cost less.

    A decay of rate ``r`` over lengths within ``h`` of their middle is missed by ``2 (r h / 2)^n / n!`` with ``n`` nodes
    (Trefethen, Approximation Theory and Approximation Practice, ch. 8); noise moments decay at twice the rate.
    """
    if len(steps) < 4:
        return None, np.empty(0)
    low, high = float(steps.min()), float(steps.max())
    half = max(0.5 * (high - low), 1e-12)
    rate = 2.0 * max(float((1.0 / parameters[0]).max()), math.sqrt(3.0) / float(parameters[-1].min()))
    if not math.isfinite(rate):
        return None, np.empty(0)
    reach = math.log(max(0.5 * rate * half, 1e-300))
    count = 4  # noise moments grow with up to the cube of the length
    while count <= _MOST_NODES and math.log(2.0) + count * reach - math.lgamma(count + 1) > math.log(ROUND_OFF):
        count += 1
    if count >= min(len(steps), _MOST_NODES):
        return None, np.empty(0)
    x = np.cos(np.pi * (np.arange(count) + 0.5) / count)
    polynomials = np.polynomial.chebyshev.chebvander
    at = polynomials((steps.numpy() - 0.5 * (low + high)) / half, count - 1)
    return torch.from_numpy(0.5 * (low + high) + half * x), at @ np.linalg.inv(polynomials(x, count - 1))


def _discretised(parameters: Six, lengths: Tensor) -> tuple[Array, Array, Array]:
    """Transition, push per unit of command and noise: ``(step, draw, 4, 4)``, ``(step, draw, 4)`` and again
    ``(step, draw, 4, 4)``."""
    step = discretise(*parameters, lengths[:, None])
    return step.transition.numpy(), step.gain.numpy(), step.noise.numpy()


def _interpolated(table: tuple[Array, Array, Array], weights: Array) -> list[Array]:
    """The same for the steps of ``weights`` ``(step, node)``."""
    return [(weights @ x.reshape(len(x), -1)).reshape(len(weights), *x.shape[1:]) for x in table]
