r"""Values of the latent log likelihood on even rows, without a graph: `latent_steady` for many parameters at once.

The law, its stationary start and the correction for the true start are those of `latent_steady`. Here nothing is
differentiated, so the products of small matrices run over contiguous numbers: a window's likelihood at 256 parameters
takes about a quarter of the time. What looks far ahead for nothing in a graph is a recursion here (Horner's rule from
block to block).
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from avtorch.arrays import Float, IntArray
from avtorch.inference.latent_model import ACCEL_ROW, SPEED_ROW, discretise, initial_covariance
from avtorch.inference.latent_steady import BLOCK, EvenRows

Array = NDArray[Any]


@torch.no_grad()
def steady_values(
    T_L: Float[Tensor, "*draw run"],
    K_L: Float[Tensor, "*draw run"],
    process_noise: Float[Tensor, "*draw run"],
    coloured_sd: Float[Tensor, "*draw run"],
    coloured_time: Float[Tensor, "*draw run"],
    data: EvenRows,
    *,
    accel_noise: Float[Tensor, "*draw run"] | None = None,
    speed_noise: Float[Tensor, "*draw run"] | None = None,
    road_noise: Float[Tensor, "*draw run"] | None = None,
) -> Float[Tensor, "*draw run"]:
    """Log likelihood ``(..., run)`` [nats], as `steady_log_likelihood`, with no gradient; NaN where digits are lost."""
    lead, runs = T_L.shape[:-1], T_L.shape[-1]
    road = torch.zeros_like(T_L) if road_noise is None else road_noise
    dt = data.dt.expand(T_L.shape).reshape(-1)
    lag, gain, rough, shaken, sd, length = (
        p.reshape(-1) for p in (T_L, K_L, process_noise, road, coloured_sd, coloured_time)
    )
    step = discretise(lag, gain, rough, shaken, sd, length, dt)
    matrices = (step.transition, step.gain[..., None], step.noise, initial_covariance(sd, length))
    sensors, noises = [], []
    for measured, noise, row in ((data.has_speed, speed_noise, SPEED_ROW), (data.has_accel, accel_noise, ACCEL_ROW)):
        if measured and noise is not None:
            sensors.append(row)
            noises.append(noise.reshape(-1) ** 2)
    # without speed its state is unobservable and has no stationary law: leave it out
    keep = slice(0 if data.has_speed else 1, None)
    phi, B, Q, P0 = (x[:, keep, keep if x.shape[-1] > 1 else slice(None)].numpy() for x in matrices)
    H = np.array(sensors)[:, keep]
    with np.errstate(all="ignore"):
        found = _values(phi, B, Q, P0, H, torch.stack(noises, -1).numpy(), data, runs)
    return torch.from_numpy(found).reshape(*lead, runs)


def _values(phi: Array, B: Array, Q: Array, P0: Array, H: Array, R: Array, data: EvenRows, runs: int) -> Array:
    """For matrices ``(draw·run, n, ...)``, runs innermost; returns ``(draw·run,)``."""
    m, n = H.shape
    P = riccati_limit(phi, H, Q, R)
    HP = H @ P
    S = HP @ H.T
    S[:, range(m), range(m)] += R
    white, log_det = _inverse_root(S)
    M = phi - phi @ (_t(HP) @ (_t(white) @ white)) @ H
    drive = np.concatenate((phi @ _t(HP) @ (_t(white) @ white), B), -1)
    seen, pushed, leap = white @ H, drive, M
    covered = 1
    while covered < BLOCK:  # seen: white H M^j, one lag after another; pushed: M^j drive
        seen = np.concatenate((seen, seen @ leap), -2)
        pushed = np.concatenate((pushed, leap @ pushed), -1)
        leap, covered = leap @ leap, 2 * covered
    now = np.concatenate((white, np.zeros_like(white[..., :1])), -1)
    response = np.concatenate((now, -(seen[:, :m] @ pushed[..., : -(m + 1)])), -1)

    D = P0 - P
    out = np.empty(len(phi))
    for run in range(runs):
        mine = slice(run, None, runs)
        used = data.used[run].numpy().reshape(-1, BLOCK).T  # (BLOCK, block)
        blocks = used.shape[1]
        lagged = data.lagged[run].numpy().reshape(-1, blocks, BLOCK)
        chains = len(phi[mine])
        by_age = np.ascontiguousarray(lagged.transpose(0, 2, 1)).reshape(len(lagged), -1)
        local = (response[mine].reshape(chains * m, -1) @ by_age).reshape(chains, m, BLOCK, blocks)
        arrived = (pushed[mine].reshape(chains * n, -1) @ np.ascontiguousarray(lagged[..., -1])).reshape(chains, n, -1)
        hop = leap[mine]
        start = np.zeros_like(arrived)
        for b in range(1, blocks):
            start[..., b] = (hop @ start[..., b - 1, None])[..., 0] + arrived[..., b - 1]
        # lags of one sensor behind one another, as the rows of a block are
        looks = seen[mine].reshape(chains, BLOCK, m, n).transpose(0, 2, 1, 3).reshape(chains, m * BLOCK, n)
        e = ((local.reshape(chains, m * BLOCK, blocks) - looks @ start).reshape(chains, m, BLOCK, blocks)) * used
        e = e.reshape(chains, m * BLOCK, blocks)
        by_block = _t(looks) @ e
        j, J = by_block[..., -1:], _information(looks, used[:, -1], m)
        whole = _information(looks, np.ones(BLOCK), m)
        for b in range(blocks - 2, -1, -1):
            inside = whole if used[:, b].all() else _information(looks, used[:, b], m)
            j = _t(hop) @ j + by_block[..., b, None]
            J = _t(hop) @ J @ hop + inside
        inflated = torch.from_numpy(np.eye(n) + D[mine] @ J)
        solved, lost = torch.linalg.solve_ex(inflated, torch.from_numpy(D[mine] @ j))
        gained = (_t(j) @ solved.numpy())[:, 0, 0]
        gained[lost.numpy() != 0] = np.nan
        total = float(data.count[run]) * (log_det[mine] + m * math.log(2.0 * math.pi)) + np.square(e).sum((1, 2))
        out[mine] = -0.5 * (total + torch.linalg.slogdet(inflated)[1].numpy() - gained)
    return out


def riccati_limit(phi: Array, H: Array, Q: Array, R: Array) -> Array:
    """The stationary predicted covariance ``(case, n, n)`` by structured doubling, for sensors ``H`` ``(m, n)``.

    ``phi``, ``Q`` ``(case, n, n)``, variances ``R`` ``(case, m)``. The k-th step covers ``2^k`` rows.
    """
    A, X, limit = np.ascontiguousarray(_t(phi)), Q, Q.copy()
    G = H.T @ (H / R[:, :, None])
    open_: IntArray = np.arange(len(Q))
    eye = np.eye(Q.shape[-1])
    for k in range(40):
        # one factorisation, two contiguous answers: products of strided matrices take three times as long
        factors, pivots, lost = torch.linalg.lu_factor_ex(torch.from_numpy(eye + G @ X))
        WA, WG = (torch.linalg.lu_solve(factors, pivots, torch.from_numpy(x)).contiguous().numpy() for x in (A, G))
        if bool(lost.any()):
            WA[lost.numpy() != 0] = np.nan
        added = np.ascontiguousarray(_t(A)) @ X @ WA
        X = X + added
        if k >= 7:
            # what a step adds is positive: its largest entry is on the diagonal. The next would add the square of it,
            # and 1e-7 squared is below the round-off; NaN counts as done
            more = _diagonal(added).max(1) > 1e-7 * _diagonal(X).max(1)
            limit[open_] = X
            if not bool(more.any()):
                return 0.5 * (limit + _t(limit))
            if not bool(more.all()):
                open_ = open_[more]
                A, X, G, WA, WG = (x[more] for x in (A, X, G, WA, WG))
        G = G + A @ WG @ np.ascontiguousarray(_t(A))
        A = A @ WA
    limit[open_] = np.nan
    return 0.5 * (limit + _t(limit))


def _information(looks: Array, used: Array, m: int) -> Array:
    """``Σ lookᵀ look`` over the rows of a block in use, ``(case, n, n)``."""
    return _t(looks) @ (looks * np.tile(used, m)[:, None])


def _inverse_root(S: Array) -> tuple[Array, Array]:
    """Inverse Cholesky root of one or two sensors' covariance ``(case, m, m)``, and its log determinant."""
    first = np.sqrt(S[:, 0, 0])
    white = np.zeros_like(S)
    white[:, 0, 0] = 1.0 / first
    if S.shape[-1] == 1:
        return white, 2.0 * np.log(first)
    low = S[:, 1, 0] / first
    second = np.sqrt(S[:, 1, 1] - low**2)
    white[:, 1, 1] = 1.0 / second
    white[:, 1, 0] = -low * white[:, 0, 0] / second
    return white, 2.0 * (np.log(first) + np.log(second))


def _diagonal(x: Array) -> Array:
    return x.diagonal(axis1=1, axis2=2)


def _t(x: Array) -> Array:
    return x.swapaxes(-1, -2)
