"""What a longer time gap costs in throughput, and what it gains in string stability.

At equilibrium a lane carries `3600 v / (tau v + standstill + length)` vehicles an hour (paper, Section 4.5, leaves the
price of a longer gap open). The belief gives the probability of string stability at each gap, and the peak gain.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from avtorch.decision.settings import Number, Setting
from avtorch.errors import InputError
from avtorch.vehicle import stability
from avtorch.vehicle.performance import equilibrium_throughput


@dataclass(frozen=True)
class GapTradeOff:
    """By time gap, every tensor (gap,): `throughput_vph`, `p_string_stable`, `peak_gain` as (5 %, median, 95 %) [-],
    infinite where locally unstable, and `cost_vph`, what is lost against the first gap.
    """

    time_gap: Tensor
    speed_mps: float
    throughput_vph: Tensor
    p_string_stable: Tensor
    peak_gain: tuple[Tensor, Tensor, Tensor]

    @property
    def cost_vph(self) -> Tensor:
        return self.throughput_vph[0] - self.throughput_vph

    def least_gap(self, required: float = 0.95) -> float | None:
        """The shortest of the gaps [s] that reaches P(string stable) `required`, None where none does."""
        enough = torch.nonzero(self.p_string_stable >= required)
        return float(self.time_gap[enough[:, 0]].min()) if len(enough) else None


@torch.no_grad()
def gap_trade_off(
    T_L: Tensor,
    K_L: Tensor,
    time_gaps: Sequence[float] | Tensor,
    *,
    setting: Setting | None = None,
    speed: float = 25.0,
    standstill: float = 5.0,
    dead_time: Number = 0.0,
    link_delay: float = 0.0,
) -> GapTradeOff:
    """Throughput, P(string stable) and peak gain over `time_gaps` (gap,) [s] under draws T_L [s], K_L [-] (draw,).

    `setting` (one scenario, its own time gap unused) gives lower level, gains and feed-forward; `speed` [m/s] is that
    of the traffic. Raises `InputError` for draws or gaps that are not one-dimensional, or a setting of several
    scenarios.
    """
    gaps = torch.as_tensor(time_gaps, dtype=torch.float64)
    if gaps.ndim != 1 or len(gaps) == 0 or T_L.ndim != 1 or T_L.shape != K_L.shape:
        raise InputError(
            f"time_gaps, T_L, K_L: found shapes {tuple(gaps.shape)}, {tuple(T_L.shape)} and {tuple(K_L.shape)}, "
            "need (gap,) and (draw,) twice"
        )
    held = Setting() if setting is None else setting
    if held.shape != (1,):
        raise InputError(f"setting: found shape {tuple(held.shape)}, needs one, (1,)")
    T_e, K_e = held.effective(T_L.double()[None], K_L.double()[None])
    belief = stability.stability_belief(
        T_e[0],
        K_e[0],
        gaps,
        held.gains[0],
        dead_time=dead_time,
        feedforward=held.feedforward[0],
        feedforward_delay=link_delay,
    )
    peak = belief.margins["peak_gain"]
    flow = equilibrium_throughput(speed, gaps, standstill=standstill)
    return GapTradeOff(gaps, speed, flow, belief.p_string_stable, (peak.q05, peak.q50, peak.q95))
