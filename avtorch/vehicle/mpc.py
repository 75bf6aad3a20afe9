r"""A linear constant-time-gap MPC with box limits on the demanded acceleration, batched over scenarios.

Internal model, state `x = (Δs, Δv, a)`, leader assumed at constant speed, GLVD `(T, K)`:

    Δs' = Δv - tau a,   Δv' = -a,   a' = (K u - a) / T,   u held for `step`

Every tick it minimises `Σ_j q_s Δs_j² + q_v Δv_j² + q_a a_j² + r u_j²` over the horizon within `[u_min, u_max]` and
demands the first move. The states are eliminated (condensed form), which leaves a strongly convex box problem
`½ Uᵀ H U + (F x)ᵀ U` of `horizon / step` variables with `H` constant.

Where the unconstrained optimum `-H⁻¹ F x` lies inside the box it is the solution. Elsewhere: the primal-dual active set
method (a semismooth Newton method; Hintermüller, Ito and Kunisch 2002), which ends after a few solves at the exact
optimum and, started afresh each tick, gives a scenario the same result in any batch. It can cycle in theory; problems
not settled after 20 rounds go to SciPy's bounded least squares, which takes one problem at a time.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Sequence
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor

from avtorch.arrays import Float
from avtorch.errors import InputError
from avtorch.vehicle.arguments import broadcast, checked
from avtorch.vehicle.controllers import RAMP_RATE, FollowerState, TimeGap

_ROUNDS = 20  # of the active set method; 3 to 6 are usual


class MPC:
    """Controller `mpc(state) -> demanded acceleration (..., scenario)` [m/s²].

    Args:
        time_gap: [s].
        standstill: [m].
        horizon, step: [s]; 4 s at 0.2 s by default: several times the loop's slowest time constant, in steps shorter
            than the actuator's lag.
        T_hat, K_hat: internal model of the actuator, [s] and [-].
        accel_min, accel_max: the box [m/s²].
        weights: (q_s [1/m²], q_v [s²/m²], q_a [s⁴/m²], r [s⁴/m²]); the default puts a spacing error of 1 m, a speed
            difference of 1 m/s and a demand of 1 m/s² level.

    Raises `InputError` for numbers out of range or a horizon that is no whole number of steps.

    Example:
        >>> from avtorch import MPC, stability
        >>> mpc = MPC(time_gap=1.6)
        >>> bool(stability.string_stable(T_L=0.3, K_L=1.0, time_gap=1.6, gains=mpc.gains))
        True
    """

    def __init__(
        self,
        *,
        time_gap: float = 1.0,
        standstill: float = 5.0,
        horizon: float = 4.0,
        step: float = 0.2,
        T_hat: float = 0.3,
        K_hat: float = 1.0,
        accel_min: float = -6.0,
        accel_max: float = 4.0,
        weights: Sequence[float] = (1.0, 1.0, 0.0, 1.0),
    ) -> None:
        self.time_gap = float(checked("time_gap", time_gap, unit="s", least=0.0))
        self.standstill = float(checked("standstill", standstill, unit="m", least=0.0))
        lag = float(checked("T_hat", T_hat, unit="s", above=0.0))
        gain = float(checked("K_hat", K_hat, above=0.0))
        self.step = float(checked("step", step, unit="s", above=0.0))
        moves = round(float(checked("horizon", horizon, unit="s", above=0.0)) / self.step)
        if moves < 1 or abs(moves * self.step - horizon) > 1e-9:
            raise InputError(f"horizon: found {horizon!r} s with step {step!r} s, needs a whole number of steps")
        if not -math.inf < accel_min < accel_max < math.inf:
            raise InputError(f"accel_min: found {accel_min!r} with accel_max {accel_max!r}, needs a lower value")
        q = checked("weights", weights, least=0.0)
        if q.shape != (4,) or float(q[3]) <= 0:
            raise InputError(f"weights: found {tuple(weights)!r}, needs q_s, q_v, q_a >= 0 and r > 0")
        self.accel_min, self.accel_max = float(accel_min), float(accel_max)
        self.T_hat, self.K_hat, self.moves, self.weights = lag, gain, moves, tuple(map(float, q))
        self.ramp: TimeGap | None = None
        self._condense()

    def _condense(self) -> None:
        moves, q = self.moves, torch.tensor(self.weights, dtype=torch.float64)
        tau, T, K, h = self.time_gap, self.T_hat, self.K_hat, self.step
        drift = torch.tensor([[0, 1, -tau, 0], [0, 0, -1, 0], [0, 0, -1 / T, K / T], [0, 0, 0, 0]], dtype=torch.float64)
        held = torch.matrix_exp(drift * h)
        A, B = held[:3, :3], held[:3, 3]
        powers = [torch.eye(3, dtype=torch.float64)]
        for _ in range(moves):
            powers.append(A @ powers[-1])
        # x_j = A^j x_0 + Σ_{i<j} A^{j-1-i} B u_i, j = 1…moves
        free = torch.stack(powers[1:])  # (step, 3, 3)
        forced = torch.zeros(moves, 3, moves, dtype=torch.float64)
        for j in range(moves):
            for i in range(j + 1):
                forced[j, :, i] = powers[j - i] @ B
        weight = q[:3, None]
        self._H = 2 * (torch.einsum("jsi,jsk->ik", forced, weight * forced) + q[3] * torch.eye(moves, dtype=q.dtype))
        self._F = 2 * torch.einsum("jsi,jsk->ik", forced, weight * free)  # (move, 3)
        self._law = -_solved(self._H, self._F)

    def __call__(self, state: FollowerState) -> Float[Tensor, "*scenario"]:
        gap = self.time_gap
        if self.ramp is not None and state.time < self.ramp.done_at:
            gap = self.ramp.at(state.time)
        error = state.spacing - (gap * state.speed + self.standstill)
        seen = broadcast(error, state.lead_speed - state.speed, state.accel)
        return self.plan(torch.stack(seen, -1))[..., 0]

    def plan(self, x: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch move"]:
        """Optimal moves (..., move) [m/s²] from states `x` = (Δs [m], Δv [m/s], a [m/s²]), (..., 3)."""
        free = x @ self._law.T
        outside = ((free < self.accel_min) | (free > self.accel_max)).any(-1)
        if not bool(outside.any()):
            return free
        out = free.clone()
        out[outside] = self._solve(x[outside] @ self._F.T, free[outside])
        return torch.clamp(out, self.accel_min, self.accel_max)  # set the exact limit: not counted as clipped

    def _solve(
        self, linear: Float[Tensor, "problem move"], guess: Float[Tensor, "problem move"]
    ) -> Float[Tensor, "problem move"]:
        """Minimiser in the box for `linear` = F x, (problem, move); `guess` is the unconstrained one."""
        above, below = guess > self.accel_max, guess < self.accel_min
        eye = torch.eye(linear.shape[-1], dtype=linear.dtype)
        out, moved = guess, (above | below).any(-1)
        for _ in range(_ROUNDS):
            # one linear system: the gradient of the free moves vanishes, the others are at their bound
            bound = torch.where(above, self.accel_max, self.accel_min)
            pinned = above | below
            rows = torch.where(pinned.unsqueeze(-1), eye, self._H)
            out = _solved(rows, torch.where(pinned, bound, -linear))
            out = torch.where(pinned, bound, out)
            push = -(out @ self._H + linear) / self._H.diagonal()
            was = above, below
            above = torch.where(above, push > 0, out > self.accel_max)
            below = torch.where(below, push < 0, out < self.accel_min)
            moved = ((above != was[0]) | (below != was[1])).any(-1)
            if not bool(moved.any()):
                return out
        out[moved] = self._one_by_one(linear[moved])
        return out

    def _one_by_one(self, linear: Float[Tensor, "problem move"]) -> Float[Tensor, "problem move"]:
        """The same by bounded least squares, one problem after the other."""
        # imported here, because it takes longer than all of this package and is hardly ever needed
        from scipy.optimize import lsq_linear  # pyright: ignore[reportMissingTypeStubs, reportUnknownVariableType]

        root = np.linalg.cholesky(self._H.numpy())
        targets = -np.linalg.solve(root, linear.numpy().T).T
        box = (self.accel_min, self.accel_max)
        solve = cast(Callable[..., Any], lsq_linear)
        return torch.as_tensor(np.stack([solve(root.T, b, box, method="bvls").x for b in targets]))

    @property
    def gains(self) -> tuple[float, float, float]:
        """`(k_s, k_v, k_a)` of the MPC away from the limits, where it is linear: `u = k_s Δs + k_v Δv + k_a a`.

        With these the stability analysis of the linear controller holds for the MPC (small motions).
        """
        k_s, k_v, k_a = (float(x) for x in self._law[0])
        return k_s, k_v, k_a

    def time_gap_at(self, time: float) -> Float[Tensor, "*setting"]:
        """The time gap [s] in force at `time` [s]."""
        return checked("time_gap", self.time_gap) if self.ramp is None else self.ramp.at(time)

    def retargeted(self, *, at: float, time_gap: float, rate: float = RAMP_RATE) -> MPC:
        """The same MPC with a new time gap from `at` [s] on, reached at `rate` [s/s]; see `LinearController`.

        The prediction uses the new gap at once, the error `Δs` the one in force.
        """
        new = copy.copy(self)
        new.time_gap = time_gap
        new._condense()
        new.ramp = TimeGap(target=time_gap, start=self.time_gap_at(at), since=at, rate=rate)
        return new


def _solved(matrix: Tensor, right: Tensor) -> Tensor:
    """`torch.linalg.solve`, which has no types."""
    return torch.linalg.solve(matrix, right)  # pyright: ignore[reportUnknownMemberType, reportUnknownVariableType]
