r"""The latent log likelihood on even rows, without a loop over time: exact, and milliseconds for 64 chains.

On even rows the Kalman filter is time-invariant except for its start. Two facts reduce it to matrix products:

- Started from the *stationary* covariance ``P`` the gain is constant from the first row, and the innovations are a
  linear filter of the data: inside blocks of rows by their impulse response, across blocks by a scan.
- A start ``N(0, P0)`` is the stationary start with a random mean, ``m ~ N(0, D)``, ``D = P0 - P``. Innovations are
  linear in that mean, ``e - E m``, so it integrates out in closed form: with ``J = EᵀE``, ``j = Eᵀe``

  .. math:: \log p = \log p_P + \tfrac12 j^T (I + D J)^{-1} D j - \tfrac12 \log\det(I + D J)

  which also holds where ``D`` is not positive. So nothing is truncated, and no transient has to decay.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from avtorch.arrays import Bool, Float
from avtorch.inference.latent_model import ACCEL_ROW, SPEED_ROW, discretise, initial_covariance

BLOCK = 32


@dataclass(frozen=True)
class EvenRows:
    """Even runs of rows, laid out once for `steady_log_likelihood`.

    ``lagged`` ``(run, BLOCK·channel, block·BLOCK)``: the part of its own block that each row uses, newest first;
    channels are the measured ones, then the command. ``used`` ``(run, block·BLOCK)``; ``count`` rows in use; ``dt`` [s]
    ``(run,)``.
    """

    lagged: Float[Tensor, "run lag padded"]
    used: Float[Tensor, "run padded"]
    count: Float[Tensor, " run"]
    dt: Float[Tensor, " run"]
    has_speed: bool
    has_accel: bool

    @classmethod
    def build(
        cls,
        dt: Float[Tensor, " run"],
        u: Float[Tensor, "run time"],
        used: Bool[Tensor, "run time"],
        *,
        accel: Float[Tensor, "run time"] | None,
        speed: Float[Tensor, "run time"] | None,
    ) -> EvenRows:
        """From ``dt (run,)`` and rows ``(run, time)``; ``used`` is True on a leading stretch of each run."""
        signals = [] if speed is None else [speed - speed[..., :1]]
        signals += [] if accel is None else [accel]
        data = torch.stack((*signals, u), -1) * used[..., None]
        pad = -u.shape[-1] % BLOCK
        data = torch.nn.functional.pad(data, (0, 0, 0, pad))
        used = torch.nn.functional.pad(used, (0, pad))
        blocks = data.unflatten(1, (-1, BLOCK))
        row = torch.arange(BLOCK, device=u.device)
        age = row[:, None] - row
        lagged = blocks[:, :, age.clamp(min=0)] * (age >= 0)[..., None]
        lagged = lagged.flatten(-2).flatten(1, 2).mT.contiguous()
        return cls(lagged, used.to(u.dtype), used.sum(-1).to(u.dtype), dt, speed is not None, accel is not None)


def _solved(A: Tensor, B: Tensor) -> Tensor:
    """``A⁻¹ B``; NaN, and no error, where ``A`` has no inverse: far outside the posterior digits are lost."""
    out, lost = torch.linalg.solve_ex(A, B)
    return torch.where((lost != 0)[..., None, None], torch.nan, out)


def _riccati_limit(phi: Tensor, H: Tensor, Q: Tensor, R: Tensor) -> Tensor:
    """The limit by structured doubling: the k-th step covers ``2^k`` rows, so a dozen cover any memory."""
    A, X = phi.mT, Q
    G = H.mT @ (H / R.diagonal(dim1=-2, dim2=-1)[..., None])
    n = Q.shape[-1]
    eye = torch.eye(n, dtype=Q.dtype, device=Q.device)
    for _ in range(40):
        WA, WG = _solved(eye + G @ X, torch.cat((A, G), -1)).split(n, -1)
        added = A.mT @ X @ WA
        X = X + added
        # Convergence is quadratic: further steps are below round-off.
        if not bool((added.abs().amax((-2, -1)) > 1e-9 * X.abs().amax((-2, -1))).any()):  # NaN never converges
            break
        G = G + A @ WG @ A.mT
        A = A @ WA
    return 0.5 * (X + X.mT)


class _Stationary(torch.autograd.Function):
    """Implicit derivatives of the Riccati limit; the backward pass is differentiable itself, to any order."""

    @staticmethod
    def forward(ctx: Any, phi: Tensor, H: Tensor, Q: Tensor, R: Tensor) -> Tensor:
        P = _riccati_limit(phi, H, Q, R)
        ctx.save_for_backward(phi, H, R, P)
        return P

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, None, Tensor, Tensor]:
        phi, H, R, P = ctx.saved_tensors
        n = P.shape[-1]
        # H P Hᵀ + R is symmetric
        K = _solved(H @ P @ H.mT + R, H @ P).mT
        push = phi @ K
        M = phi - push @ H
        # dP = M dP Mᵀ + ..., so the gradient solves G = Mᵀ G M + grad, here with rows of G in order.
        kron = (M.mT[..., :, None, :, None] * M.mT[..., None, :, None, :]).flatten(-4, -3).flatten(-2, -1)
        eye = torch.eye(n * n, dtype=P.dtype, device=P.device)
        grad = 0.5 * (grads[0] + grads[0].mT)
        G = _solved(eye - kron, grad.flatten(-2)[..., None])[..., 0].unflatten(-1, (n, n))
        return 2.0 * G @ phi @ (P - K @ H @ P), None, G, push.mT @ G @ push


def stationary_covariance(
    phi: Float[Tensor, "*batch n n"],
    H: Float[Tensor, "m n"],
    Q: Float[Tensor, "*batch n n"],
    R: Float[Tensor, "*batch m m"],
) -> Float[Tensor, "*batch n n"]:
    """Predicted covariance ``P = φ(P - P Hᵀ S⁻¹ H P)φᵀ + Q``, ``(..., n, n)``; differentiable in ``φ, Q, R``.

    ``H (m, n)`` is constant, ``R (..., m, m)`` diagonal.
    """
    out = _Stationary.apply(phi, H, Q, R)
    assert isinstance(out, Tensor)
    return out


def _powers(M: Tensor, count: int) -> Tensor:
    """``M^0 ... M^(count-1)`` stacked on a new dimension before the matrix: ``(..., count, n, n)``."""
    out = torch.eye(M.shape[-1], dtype=M.dtype, device=M.device).expand(M.shape)[..., None, :, :]
    leap = M
    while out.shape[-3] < count:
        out = torch.cat((out, leap[..., None, :, :] @ out), -3)
        leap = leap @ leap
    return out[..., :count, :, :]


def _scan(A: Float[Tensor, "... n n"], r: Float[Tensor, "*all block n"]) -> Float[Tensor, "*all block n"]:
    """States at the block starts, ``s_0 = 0``, ``s_{b+1} = A s_b + r_b``; ``r`` ``(..., block, n)``."""
    s = torch.nn.functional.pad(r[..., :-1, :], (0, 0, 1, 0))
    leap, hop = A, 1
    while hop < s.shape[-2]:
        s = s + torch.nn.functional.pad(s[..., :-hop, :] @ leap.mT, (0, 0, hop, 0))
        leap, hop = leap @ leap, 2 * hop
    return s


def steady_log_likelihood(
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
    """Log likelihood ``(..., run)``; parameters ``(..., run)``, float64: `latent_log_likelihood` on even rows."""
    lead = T_L.shape[:-1]
    runs = T_L.shape[-1]
    road = torch.zeros_like(T_L) if road_noise is None else road_noise
    T_L, K_L, process_noise, road, coloured_sd, coloured_time = (
        p.reshape(-1, runs) for p in (T_L, K_L, process_noise, road, coloured_sd, coloured_time)
    )
    step = discretise(T_L, K_L, process_noise, road, coloured_sd, coloured_time, data.dt)
    phi, B, Q, P0 = step.transition, step.gain, step.noise, initial_covariance(coloured_sd, coloured_time)
    sensors = []
    noises = []
    if data.has_speed and speed_noise is not None:
        sensors.append(SPEED_ROW)
        noises.append(speed_noise.reshape(-1, runs) ** 2)
    if data.has_accel and accel_noise is not None:
        sensors.append(ACCEL_ROW)
        noises.append(accel_noise.reshape(-1, runs) ** 2)
    H, R = phi.new_tensor(sensors), torch.diag_embed(torch.stack(noises, -1))
    if not data.has_speed:
        # The speed is then unobservable and has no stationary law: leave it out.
        phi, B, Q, P0, H = phi[..., 1:, 1:], B[..., 1:], Q[..., 1:, 1:], P0[..., 1:, 1:], H[..., 1:]
    n, m = phi.shape[-1], H.shape[0]

    P = stationary_covariance(phi, H, Q, R)
    # far outside the posterior the covariance may lose its digits too
    root, lost = torch.linalg.cholesky_ex(H @ P @ H.mT + R)
    root = torch.where((lost > 0)[..., None, None], torch.nan, root)
    white = torch.linalg.inv(root)
    K = P @ H.mT @ white.mT @ white
    M = phi - phi @ K @ H
    drive = torch.cat((phi @ K, B[..., None]), -1)  # contribution of a row's measurements and command to the next mean
    powers = _powers(M, BLOCK)
    seen = ((white @ H)[..., None, :, :] @ powers).transpose(-3, -2).flatten(2, 3)  # (chain, run, m·BLOCK, n)
    pushed = powers @ drive[..., None, :, :]  # (chain, run, BLOCK, n, m + 1)

    # Impulse response of the whitened innovation, newest row first.
    now = torch.cat((white, torch.zeros_like(white[..., :1])), -1)[..., None, :, :]
    response = torch.cat((now, -(white @ H)[..., None, :, :] @ pushed[..., :-1, :, :]), -3)

    def through(kernel: Tensor, rows: Tensor) -> Tensor:
        """``kernel (chain, run, BLOCK, out, m + 1)`` on ``rows (run, BLOCK·(m + 1), row)``: (chain, run, out, row)."""
        chains, out = kernel.shape[0], kernel.shape[-2]
        flat = kernel.permute(1, 0, 3, 2, 4).reshape(runs, chains * out, -1)
        return (flat @ rows).unflatten(1, (chains, out)).transpose(0, 1)

    blocks = data.used.shape[-1] // BLOCK
    leap = powers[..., -1, :, :] @ M
    start = _scan(leap, through(pushed, data.lagged[..., BLOCK - 1 :: BLOCK]).mT)  # (chain, run, block, n)
    local = through(response, data.lagged).unflatten(-1, (blocks, BLOCK)).transpose(2, 3).flatten(3)
    used = data.used.reshape(runs, blocks, BLOCK)
    e = (local - start @ seen.mT) * used.repeat(1, 1, m)  # (chain, run, block, m·BLOCK)
    # Innovations depend on the first mean as E = H M^t: block by block, seen · leap^block.
    far = _powers(leap, blocks)
    pairs = (seen[..., :, None] * seen[..., None, :]).flatten(-2).unflatten(2, (m, BLOCK)).sum(2)
    in_block = (used @ pairs).unflatten(-1, (n, n))
    J = (far.mT @ in_block @ far).sum(-3)
    j = (far.mT @ (e @ seen)[..., None]).sum(-3)
    D = P0 - P
    inflated = torch.eye(n, dtype=D.dtype, device=D.device) + D @ J
    gained = (j.mT @ _solved(inflated, D @ j))[..., 0, 0]
    log_det = 2.0 * root.diagonal(dim1=-2, dim2=-1).log().sum(-1)
    misfit = e.square().sum((-2, -1))
    total = data.count * (log_det + m * math.log(2.0 * math.pi)) + misfit + torch.linalg.slogdet(inflated)[1] - gained
    return -0.5 * total.reshape(*lead, runs)
