"""Stability of the loop around any linear chain: dead time, a second pole, a late sensor, drag.

With `P` from command to acceleration, `S` from acceleration to its reading, a drag `d` and a lower level that sends
`alpha` times the reading plus `beta` times the upper level's demand, the loop is

    F(s) = (1 - alpha P S) s (s + d) + beta P (k_s + g s - k_a S s^2),    g = k_s tau + k_v
    V / V_lead = beta P (k_s + k_v s + k_f s^2 exp(-s theta_f)) / F

`P` and `S` are stable and fade at high frequencies, so `F / (s + 1)^2` goes to 1 and its phase along the imaginary axis
counts the growing modes (the argument principle). All of it is evaluated on a grid of frequencies.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from avtorch.arrays import Bool, Complex, Float, Inexact
from avtorch.errors import InputError
from avtorch.vehicle.arguments import broadcast

SLACK = 1e-4
"""A gain above one by less than this counts as one: the error of responses measured on a grid."""


@dataclass(frozen=True)
class Chain:
    """A car for small motions: `omega` (frequency,) [rad/s], rising from near 0 to where the response has vanished.

    `motion` (..., frequency): complex acceleration for a unit command; `sensed` (..., frequency): the reading's share
    of the acceleration; `drag` (...) [1/s]: decrease of the acceleration per unit of speed. Raises `InputError` for
    fewer than ten frequencies, frequencies that do not rise from above 0, or responses of another length.
    """

    omega: Float[Tensor, " frequency"]
    motion: Complex[Tensor, "*#batch frequency"]
    sensed: Inexact[Tensor, "*#batch frequency"]
    drag: Float[Tensor, "*#batch"]

    def __post_init__(self) -> None:
        rises = bool((self.omega[1:] > self.omega[:-1]).all()) and float(self.omega[0]) > 0
        if self.omega.ndim != 1 or not rises or len(self.omega) < 10:
            raise InputError("omega: needs ten or more rising frequencies above 0")
        for name in ("motion", "sensed"):
            if getattr(self, name).shape[-1:] != self.omega.shape:
                raise InputError(f"{name}: found shape {tuple(getattr(self, name).shape)}, needs (..., frequency)")


@dataclass(frozen=True)
class ChainVerdict:
    """`locally_stable`, `string_stable` (bool), `peak_gain` [-], inf where locally unstable, of the batch's shape."""

    locally_stable: Bool[Tensor, "*batch"]
    string_stable: Bool[Tensor, "*batch"]
    peak_gain: Float[Tensor, "*batch"]


def frequencies(*, points: int = 600, least: float = 0.01, most: float = 200.0) -> Float[Tensor, " frequency"]:
    """A grid [rad/s] for `Chain.omega`: 1.7 % apart, from far below a platoon's modes to far above an actuator's.

    Example:
        >>> from avtorch.vehicle.stability import frequencies
        >>> omega = frequencies(points=5, least=0.01, most=100.0)
        >>> omega.round(decimals=3).tolist()
        [0.01, 0.1, 1.0, 10.0, 100.0]
    """
    return torch.logspace(math.log10(least), math.log10(most), points, dtype=torch.float64)


def actuator(
    omega: Float[Tensor, " frequency"],
    T_L: Float[Tensor, "*#batch"],
    K_L: Float[Tensor, "*#batch"],
    dead_time: float | Float[Tensor, "*#batch"] = 0.0,
) -> Chain:
    """GLVD with a dead time [s] as a chain, parameters (...).

    Example:
        >>> import torch
        >>> from avtorch.vehicle.stability import actuator, frequencies
        >>> car = actuator(frequencies(), T_L=torch.tensor(0.3), K_L=torch.tensor(1.0), dead_time=0.4)
        >>> car.motion.dtype, round(float(car.motion[0].abs()), 3)
        (torch.complex128, 1.0)
    """
    s = 1j * omega
    T, K, theta = broadcast(T_L, K_L, torch.as_tensor(dead_time, dtype=torch.float64))
    motion = K[..., None] * torch.exp(-s * theta[..., None]) / (1 + s * T[..., None])
    return Chain(omega, motion, torch.ones_like(motion), torch.zeros_like(T))


def chain_verdict(
    chain: Chain,
    time_gap: Float[Tensor, "*#batch"],
    gains: Float[Tensor, "*#batch 3"],
    *,
    inner: float | Float[Tensor, "*#batch"] = 0.0,
    forward: float | Float[Tensor, "*#batch"] = 1.0,
    feedforward: float | Float[Tensor, "*#batch"] = 0.0,
    feedforward_delay: float = 0.0,
) -> ChainVerdict:
    """Stability of a linear controller around `chain`; batches broadcast with each other.

    `time_gap` (...) [s], `gains` (..., 3); the lower level sends `inner` times the sensed acceleration plus `forward`
    times the upper level's demand, (...) (0 and 1: it passes the demand through). `feedforward` k_f (...) [-] acts on
    the leader's acceleration `feedforward_delay` [s] ago.
    """
    loop, asked = _loop(chain, time_gap, gains, inner, forward, feedforward, feedforward_delay)
    gain = asked.abs() / loop.abs().clamp_min(1e-300)
    local = _growing(loop / (1j * chain.omega + 1) ** 2) < 0.5
    # the static response has the right sign
    local = local & (asked[..., 0].real > 0)
    peak = torch.where(local, gain.amax(-1).clamp_min(1.0), torch.inf)
    return ChainVerdict(local, local & (peak <= 1 + SLACK), peak)


def _loop(
    chain: Chain,
    time_gap: Tensor,
    gains: Tensor,
    inner: Tensor | float,
    forward: Tensor | float,
    feedforward: Tensor | float,
    feedforward_delay: float,
) -> tuple[Tensor, Tensor]:
    """F and the numerator of V / V_lead, (..., frequency)."""
    s = 1j * chain.omega
    ks, kv, ka = (k[..., None] for k in gains.unbind(-1))
    g = ks * time_gap[..., None] + kv
    alpha, beta = (torch.as_tensor(x, dtype=torch.float64)[..., None] for x in (inner, forward))
    own = (1 - alpha * chain.motion * chain.sensed) * s * (s + chain.drag[..., None])
    loop = own + beta * chain.motion * (ks + g * s - ka * chain.sensed * s**2)
    kf = torch.as_tensor(feedforward, dtype=torch.float64)[..., None]
    return loop, beta * chain.motion * (ks + kv * s + kf * s**2 * torch.exp(-s * feedforward_delay))


def _growing(curve: Complex[Tensor, "*batch frequency"]) -> Float[Tensor, "*batch"]:
    """Number of growing modes, (...): clockwise half turns of `curve` (..., frequency)."""
    turns = torch.angle(curve[..., 1:] / curve[..., :-1]).sum(-1)
    # from the real axis at omega 0 and back to it at the top
    ends = torch.angle(curve[..., 0]) - torch.angle(curve[..., -1])
    return -(turns + ends) / math.pi
