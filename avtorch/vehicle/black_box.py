r"""The string stability of a controller of unknown structure, as far as it can be determined.

Two methods, neither of which is a proof for all motions:

- `linearise`: the slopes of the controller at one equilibrium speed. Where it is a smooth function of its inputs (no
  memory, no delay of its own), small motions about that speed obey a linear law, and every exact verdict holds for
  them: k_s = ∂u/∂spacing, k_v = ∂u/∂lead_speed, k_a = ∂u/∂accel, k_f = ∂u/∂lead_accel, and the time gap is that for
  which k_s tau + k_v = -∂u/∂speed. It does not cover large motions, other speeds, or a controller with memory.
- `measured_gain`: the closed loop behind a leader whose speed oscillates at one frequency and amplitude, and the ratio
  of the speed amplitudes at that frequency. It assumes no structure. A ratio above one *proves* amplification; ratios
  of at most one at all frequencies tried prove nothing about the others.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import cast

import torch
from torch import Tensor

from avtorch.arrays import Float
from avtorch.errors import InputError
from avtorch.vehicle.controllers import Controller, FollowerState
from avtorch.vehicle.leader import Leader
from avtorch.vehicle.loop import ClosedLoop
from avtorch.vehicle.lower_level import LowerLevel
from avtorch.vehicle.plant import GLVDPlant, Plant, PlantFunction

_FAR_M = 400.0  # upper bound on any controller's gap


@dataclass(frozen=True)
class Linearised:
    """The law for small motions about `speed` [m/s], at the `spacing` [m] for which no acceleration is demanded.

    `gains` (k_s [1/s²], k_v [1/s], k_a [-]), `time_gap` [s] and `feedforward` [-] as a `LinearController`'s.
    `bend` [-]: how much the slopes over a step ten times as large differ from these, as a share of the largest; near
    0 for a smooth law, large at a kink or a step of a table, where small motions have no one law.
    """

    speed: float
    spacing: float
    gains: tuple[float, float, float]
    time_gap: float
    feedforward: float
    bend: float


def linearise(controller: Controller, speed: float, *, step: float = 0.02) -> Linearised:
    """Slopes of `controller` at its equilibrium at `speed` [m/s], by central differences of ± `step` [SI units].

    The controller is called as in the loop, with tensors (scenario,), at time 0. Raises `InputError` where it has no
    equilibrium spacing up to 400 m, answers a larger spacing with no more acceleration (k_s <= 0: it does not follow),
    or returns a number that is not finite.

    Example:
        >>> import torch
        >>> from avtorch.vehicle import linearise
        >>> def cautious(state):  # a law of unknown structure: it limits what it demands
        ...     wish = 1.2 * (state.spacing - 1.4 * state.speed - 6) + 1.3 * (state.lead_speed - state.speed)
        ...     return 3 * torch.tanh(wish / 3)
        >>> k_s, k_v, k_a = linearise(cautious, speed=20.0).gains
        >>> round(k_s, 2), round(k_v, 2)
        (1.2, 1.3)
    """
    spacing = _equilibrium(controller, speed)
    rest = (spacing, speed, 0.0, speed, 0.0)

    def slopes(h: float) -> list[float]:
        out: list[float] = []
        for i in range(5):
            up, down = ([x + sign * h * (j == i) for j, x in enumerate(rest)] for sign in (1.0, -1.0))
            out.append((_demand(controller, up) - _demand(controller, down)) / (2.0 * h))
        return out

    k_s, on_speed, k_a, k_v, k_f = slopes(step)
    if not k_s > 0.0:
        raise InputError(
            f"controller: answers a longer spacing with {k_s:g} m/s² per metre at {speed:g} m/s, needs > 0"
        )
    wide = slopes(10.0 * step)
    largest = max(abs(k) for k in (k_s, on_speed, k_a, k_v, k_f))
    bend = max(abs(a - b) for a, b in zip(wide, (k_s, on_speed, k_a, k_v, k_f), strict=True)) / largest
    return Linearised(speed, spacing, (k_s, k_v, k_a), (-on_speed - k_v) / k_s, k_f, bend)


def _equilibrium(controller: Controller, speed: float) -> float:
    """The spacing [m] at which `controller` demands no acceleration behind a leader at the same steady `speed`
    [m/s]."""
    if not (math.isfinite(speed) and speed > 0.0):
        raise InputError(f"speed: found {speed!r}, needs a number above 0 m/s")
    # imported here, because it takes longer than all of this package and few need it
    from scipy.optimize import brentq  # pyright: ignore[reportMissingTypeStubs, reportUnknownVariableType]

    low, high = 0.1, _FAR_M

    def demand(spacing: float) -> float:
        return _demand(controller, (spacing, speed, 0.0, speed, 0.0))

    if not demand(low) < 0.0 < demand(high):
        raise InputError(f"controller: has no equilibrium spacing at {speed:g} m/s between {low:g} and {high:g} m")
    return cast(float, brentq(demand, low, high, xtol=1e-9))


def _demand(controller: Controller, state: Sequence[float]) -> float:
    """The demand at (spacing, speed, accel, lead_speed, lead_accel)."""
    with torch.no_grad():
        u = float(
            controller(FollowerState(0.0, *(torch.tensor([x], dtype=torch.float64) for x in state))).reshape(-1)[0]
        )
    if not math.isfinite(u):
        raise InputError(f"controller: demanded {u} at {state[1]:g} m/s and a spacing of {state[0]:g} m")
    return u


def measured_gain(
    controller: Controller,
    omega: Sequence[float] | Tensor,
    *,
    speed: float = 25.0,
    amplitude: float = 0.5,
    plant: Plant | PlantFunction | None = None,
    lower_level: LowerLevel | None = None,
    link_delay: float = 0.0,
    settle: float = 60.0,
    cycles: int = 3,
    spacing: float | None = None,
    dt: float = 0.01,
) -> Float[Tensor, " frequency"]:
    """Amplitude of the follower's speed over that of its leader's, (frequency,), at each `omega` [rad/s].

    The leader drives `speed` + `amplitude` sin(omega t) [m/s]; all frequencies run in one batch, one per scenario, so a
    `controller` with memory must keep it by scenario. After `settle` [s] the part at `omega` alone is taken over
    `cycles` whole cycles of the slowest (harmonics of a controller that is not linear are left out). `plant` has no
    noise by default; `spacing` [m] at the start, None for the controller's equilibrium. Infinite where the follower
    collides or stops. Raises `InputError` for bad numbers, or where the leader would roll back.

    Example:
        >>> from avtorch.vehicle import NOMINAL_GAINS, LinearController, measured_gain, stability
        >>> omega = [1.0, 2.0]
        >>> measured = measured_gain(LinearController(), omega, settle=10.0, cycles=1, dt=0.02)
        >>> [round(x, 2) for x in measured.tolist()]
        [0.78, 0.5]
        >>> [round(x, 2) for x in stability.gain(omega, 0.3, 1.0, 1.0, NOMINAL_GAINS).tolist()]  # by linear theory
        [0.78, 0.5]
    """
    w = torch.as_tensor(omega, dtype=torch.float64).reshape(-1)
    if len(w) == 0 or not bool((torch.isfinite(w) & (w > 0.0)).all()):
        raise InputError("omega: needs one or more finite frequencies above 0 rad/s")
    if not 0.0 < amplitude < speed:
        raise InputError(f"amplitude: found {amplitude:g} m/s at {speed:g} m/s, needs a number above 0 and below it")
    if cycles < 1 or not settle >= 0.0:
        raise InputError(f"cycles, settle: found {cycles} and {settle}, need one cycle or more and 0 s or more")
    count = round((settle + cycles * 2.0 * math.pi / float(w.min())) / dt) + 1
    time = torch.arange(count + 1, dtype=torch.float64) * dt
    angle = w[:, None] * time
    leader = Leader(
        time,
        speed * time + amplitude / w[:, None] * (1.0 - angle.cos()),
        speed + amplitude * angle.sin(),
        amplitude * w[:, None] * angle.cos(),
        dt,
        "swinging leader",
    )
    start = _equilibrium(controller, speed) if spacing is None else spacing
    loop = ClosedLoop(
        leader,
        controller,
        lower_level=lower_level,
        plant=GLVDPlant(sigma=0.0) if plant is None else plant,
        scenarios=len(w),
        spacing0=start,
        link_delay=link_delay,
    )
    run = loop.advance(count)
    lost = run.collided | (run.speed <= 0.0).any(-1)
    gains: list[float] = []
    for i, frequency in enumerate(map(float, w)):
        period = 2.0 * math.pi / frequency
        rows = round(math.floor((count * dt - settle) / period + 1e-9) * period / dt)
        part = slice(count - rows, count)
        basis = torch.stack([angle[i, part].sin(), angle[i, part].cos(), torch.ones(rows, dtype=torch.float64)], -1)
        # torch.linalg has no types
        squares = torch.linalg.lstsq  # pyright: ignore[reportUnknownMemberType, reportUnknownVariableType]
        fit = cast(Tensor, squares(basis, run.speed[i, part, None]).solution)  # pyright: ignore[reportUnknownMemberType]
        gains.append(math.hypot(float(fit[0, 0]), float(fit[1, 0])) / amplitude)
    return torch.where(lost, torch.inf, torch.tensor(gains, dtype=torch.float64))
