"""Algorithm 2 of the paper, as printed.

    Input: estimates θ = [K_L, T_L]
    if θ outside the acceptable boundary of [K_L, T_L]:
        check stability (local and string)
        if stable:    update the lower level, [K_L, T_L] <- θ
        if unstable:  update the lower level, [K_L, T_L] <- θ, and choose a strategy:
                        1. time gap:  τ_new > τ
                        2. gains:     |k_s'| > |k_s|, |k_v'| > |k_v|, |k_a'| > |k_a|

The paper leaves the new values open; `PAPER_TIME_GAP` and `PAPER_GAINS` are those of its experiment, which calm the car
without making it string stable when the lower level passes the demand through. The paper checks the estimates
themselves, with the time gap and gains in force, not what the updated lower level would make of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from avtorch.decision.settings import Setting
from avtorch.errors import InputError
from avtorch.vehicle import stability

PAPER_TIME_GAP = 2.0
PAPER_GAINS = (3.0, 3.0, -1.8)
ACCEPTED_CHANGE = (0.2, 0.15)
"""Accepted change of T_L [s] and of K_L [-] (paper, Section 4, Strategy 1)."""

Check = Literal["print", "exact"]
Choice = Literal["time_gap", "gains"]


@dataclass(frozen=True)
class Algorithm2:
    """The branch taken, bool (scenario,) each, and the setting it leads to.

    `outside`: the estimate left the accepted boundary; `stable`: the result of the stability check (computed in every
    branch, so that it can be plotted); `lower_level_updated`, `time_gap_increased`, `gains_increased`: what was done.
    """

    outside: Tensor
    stable: Tensor
    lower_level_updated: Tensor
    time_gap_increased: Tensor
    gains_increased: Tensor
    setting: Setting


def algorithm2(
    T_L: Tensor,
    K_L: Tensor,
    setting: Setting,
    *,
    accepted: tuple[float | Tensor, float | Tensor] | None = None,
    change: tuple[float, float] = ACCEPTED_CHANGE,
    choose: Choice = "time_gap",
    new_time_gap: float | Tensor = PAPER_TIME_GAP,
    new_gains: Sequence[float] | Tensor = PAPER_GAINS,
    check: Check = "print",
) -> Algorithm2:
    """One pass of Algorithm 2 over point estimates T_L [s] and K_L [-] (scenario,), with `setting` in force.

    The boundary is `accepted` ± `change`, both (T_L, K_L); by default around the model in the lower level, which is
    what was accepted last. `check="print"` is Eq. 2 with the sufficient Eq. 3 at the estimate; `"exact"` the exact
    string condition. Raises `InputError` where a scenario takes a branch whose new time gap is not longer, or whose new
    gain is not larger in size, than the one in force, as the paper requires.

    Example:
        >>> import torch
        >>> from avtorch import Setting, algorithm2
        >>> T_L, K_L = torch.tensor([1.33], dtype=torch.float64), torch.tensor([0.64], dtype=torch.float64)
        >>> taken = algorithm2(T_L, K_L, Setting())  # the paper's estimate
        >>> taken.time_gap_increased.item(), taken.setting.time_gap.item()
        (True, 2.0)
    """
    T, K = torch.broadcast_tensors(torch.as_tensor(T_L, dtype=torch.float64), torch.as_tensor(K_L, dtype=torch.float64))
    around = (setting.T_hat, setting.K_hat) if accepted is None else accepted
    outside = ((T - around[0]).abs() > change[0]) | ((K - around[1]).abs() > change[1])
    outside, T, K = (x.expand(setting.shape) for x in (outside, T, K))

    if check == "print":
        local = stability.local_stable(T, K, setting.time_gap, setting.gains)
        stable = local & stability.string_sufficient(T, K, setting.time_gap, setting.gains, form="print")
    elif check == "exact":
        stable = stability.string_stable(T, K, setting.time_gap, setting.gains)
    else:
        raise InputError(f"check: found {check!r}, need 'print' or 'exact'")

    drastic = outside & ~stable
    never = torch.zeros_like(drastic)
    if choose == "time_gap":
        by_gap, by_gains = drastic, never
    elif choose == "gains":
        by_gap, by_gains = never, drastic
    else:
        raise InputError(f"choose: found {choose!r}, need 'time_gap' or 'gains'")

    gap = torch.as_tensor(new_time_gap, dtype=torch.float64).expand(setting.shape)
    gains = torch.as_tensor(new_gains, dtype=torch.float64).expand(*setting.shape, 3)
    if bool((by_gap & (gap <= setting.time_gap)).any()):
        raise InputError("new_time_gap: not longer than the time gap in force, as Algorithm 2 demands")
    if bool((by_gains & (gains.abs() <= setting.gains.abs()).any(dim=-1)).any()):
        raise InputError("new_gains: not all larger in size than the gains in force, as Algorithm 2 demands")

    after = setting.replace(
        T_hat=torch.where(outside, T, setting.T_hat),
        K_hat=torch.where(outside, K, setting.K_hat),
        time_gap=torch.where(by_gap, gap, setting.time_gap),
        gains=torch.where(by_gains.unsqueeze(-1), gains, setting.gains),
    )
    return Algorithm2(outside, stable, outside, by_gap, by_gains, after)
