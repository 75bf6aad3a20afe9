"""The strategist's finite grid of settings, and how intrusive each one is.

Grid, relative to the driver's default and to the setting in force:

- lower level: keep what is in force, or update the model to the estimate with a target lag between the default's and
  the estimate's, in equal steps of its logarithm. A slower target asks less of the actuator: it lowers the command
  effort T_hat K_d / (K_hat T_d).
- time gap: the one in force, the default, and the driver's settings that are longer than the default.
- gains: those in force, the default's, and a stated list of triples, calibrated beforehand.
- feed-forward: the gain in force, the default's, and, where the vehicle receives its leader's acceleration, a stated
  list of gains.

Intrusiveness is a number without unit; updating the lower level costs one. A change that nobody in the car notices
costs least; one that the driver sees on the dashboard or that the engineer has to re-approve costs more; both together
cost more than the sum:

    lower level differs from the default    1    + 0.5 for each doubling of the command effort above 1
    lower level kept though known wrong     3    (the paper: update at a minimum)
    time gap longer than the default        1.5  + 3 (gap / default - 1)
    gains differ from the default           2    + sum over gains of |log2(ratio)|, for k_a of 1 - k_a
    feed-forward differs from the default   1.5  + |k_f - default|
    both time gap and gains differ          2    more
    anything differs from what is in force  1    (do not intervene for a trifle)

so that 1 -> 1.6 s costs 3.3, 1 -> 2.5 s costs 6, doubling k_v costs 3, and k_f 0 -> 0.5 costs 2: nobody in the car
notices and no road capacity is lost, but the car then depends on a radio link. The lower level alone is cheapest (about
2 to 3.7). Next come the lower level with one step of the gap or a mild change of gains, then the longest gap or a
strong change of gains, then both gap and gains.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

import torch
from torch import Tensor

from avtorch.decision.algorithm2 import PAPER_GAINS
from avtorch.decision.settings import DRIVER_TIME_GAPS, Setting
from avtorch.errors import InputError

GAINS_GRID: tuple[tuple[float, float, float], ...] = (
    *product((1.5,), (1.5, 2.0, 3.0, 4.0, 6.0), (-0.8, -1.8, -3.0, -5.0)),
    PAPER_GAINS,
)
"""Gains (k_s, k_v, k_a) on offer: a larger k_v makes the car responsive, which a weak actuator needs; a stronger k_a
damps a slow one. k_s is kept, as it is neutral (paper, table on gains). The paper's own triple is among them."""


SWITCH = 1.0
"""Price of anything that differs from what is in force."""
MARGIN = 4.0
"""The strategist's price of a setting that barely passes."""


def intrusiveness(setting: Setting, default: Setting, stale: Tensor) -> Tensor:
    """Cost of settings relative to broadcasting defaults, by the table of the module docstring but for its last line;
    `stale`: a model known to be wrong is kept."""
    effort = (setting.amplification() / default.amplification()).log2().clamp_min(0.0)
    longer = (setting.time_gap / default.time_gap - 1.0).clamp_min(0.0)
    # A gain of zero or below has no ratio; the smallest float replaces it, so that it counts as a large change.
    k, k0 = (torch.cat([x[..., :2], 1.0 - x[..., 2:]], dim=-1).clamp_min(1e-3) for x in (setting.gains, default.gains))
    octaves = (k / k0).log2().abs().sum(dim=-1)
    fed = (setting.feedforward - default.feedforward).abs()
    gap_differs, gains_differ = longer > 1e-9, octaves > 1e-9
    lower = 1.0 * setting.lower_differs(default) + 0.5 * effort + 3.0 * stale
    upper = 1.5 * gap_differs + 3.0 * longer + 2.0 * gains_differ + octaves + 2.0 * (gap_differs & gains_differ)
    return lower + upper + 1.5 * (fed > 1e-9) + fed


@dataclass(frozen=True)
class Candidates:
    """`setting` (scenario, candidate); `cost` (scenario, candidate), infinite where a candidate is not on offer.

    The first candidate is the setting in force.
    """

    setting: Setting
    cost: Tensor


@dataclass(frozen=True)
class Grid:
    """A finite set of settings (see the module docstring).

    time_gaps [s]; gains: triples; targets: positions of T_d between the default's target lag (0) and the estimated lag
    (1); feedforward: gains k_f on the leader's acceleration, none where it is not received; allowed: strategies out
    of {1, 2, 3, 4} that may be used. gains_of_gap: for a controller whose gains follow from
    its time gap (an MPC's equivalent gains): (time gap [s]) -> triple; Strategies 3 and 4 are then not on offer. Raises
    `InputError` for an empty or impossible grid.

    Example:
        >>> import torch
        >>> from avtorch.decision import Grid, Setting
        >>> grid = Grid(time_gaps=(1.0, 1.6, 2.5), allowed=frozenset({2}))
        >>> T_L, K_L, known = torch.tensor([1.5]), torch.tensor([0.5]), torch.tensor([False])
        >>> offer = grid.candidates(T_L, K_L, current=Setting(), default=Setting(), model_wrong=known)
        >>> offer.setting.time_gap.unique().tolist()
        [1.0, 1.6, 2.5]
    """

    time_gaps: Sequence[float] = DRIVER_TIME_GAPS
    gains: Sequence[Sequence[float]] = GAINS_GRID
    targets: Sequence[float] = (0.0, 1.0 / 3.0, 2.0 / 3.0, 1.0)
    feedforward: Sequence[float] = ()
    allowed: frozenset[int] = frozenset({1, 2, 3, 4})
    gains_of_gap: Callable[[float], Sequence[float]] | None = None

    def __post_init__(self) -> None:
        if not self.allowed <= {1, 2, 3, 4}:
            raise InputError(f"allowed: found {sorted(self.allowed)}, need some of 1, 2, 3, 4")
        if any(not gap > 0.0 for gap in self.time_gaps):
            raise InputError(f"time_gaps: found {tuple(self.time_gaps)}, need numbers above 0")
        if any(not 0.0 <= t <= 1.0 for t in self.targets):
            raise InputError(f"targets: found {tuple(self.targets)}, need numbers from 0 to 1")
        if any(len(k) != 3 for k in self.gains):
            raise InputError("gains: need triples (k_s, k_v, k_a)")
        if any(not math.isfinite(k) for k in self.feedforward):
            raise InputError(f"feedforward: found {tuple(self.feedforward)}, need finite numbers")
        if self.feedforward and self.gains_of_gap is not None:
            raise InputError("feedforward: a controller whose gains follow from its time gap takes none")

    def candidates(
        self, T_L: Tensor, K_L: Tensor, *, current: Setting, default: Setting, model_wrong: Tensor
    ) -> Candidates:
        """All settings on offer at the estimates T_L [s], K_L [-] (scenario,), (scenario, candidate).

        `model_wrong` (scenario,) bool: a change of the vehicle was detected, so the model in force is known to be
        wrong.
        """
        scenarios = T_L.shape[0]
        column = default[:, None]
        # Lower level: row 0 keeps what is in force.
        targets = torch.tensor(list(self.targets) if 1 in self.allowed else [], dtype=torch.float64)
        reach = (T_L / default.T_d).log().clamp_min(0.0)[:, None]
        T_d = torch.cat([current.T_d[:, None], column.T_d * (targets * reach).exp()], dim=1)
        T_hat = torch.cat([current.T_hat[:, None], T_L[:, None].expand(-1, len(targets))], dim=1)
        K_hat = torch.cat([current.K_hat[:, None], K_L[:, None].expand(-1, len(targets))], dim=1)
        K_d = torch.cat([current.K_d[:, None], column.K_d.expand(-1, len(targets))], dim=1)
        # An estimate at or below the default's target leaves one update, not several equal ones.
        fresh = torch.cat([torch.ones(scenarios, 1, dtype=torch.bool), (targets == 0.0) | (reach > 1e-9)], dim=1)

        longer = _listed(self.time_gaps if 2 in self.allowed else (), scenarios)
        gaps, new_gap = _axis(current.time_gap, default.time_gap, longer)
        new_gap[:, 2:] &= gaps[:, 2:] > column.time_gap + 1e-9
        triples = _listed(self.gains if 3 in self.allowed else (), scenarios, 3)
        gains, new_gains = _axis(current.gains, default.gains, triples)
        if self.gains_of_gap is not None:
            new_gains[:, 1:] = False
        links = _listed(self.feedforward if 4 in self.allowed else (), scenarios)
        feedforward, new_link = _axis(current.feedforward, default.feedforward, links)

        axes = (T_d, gaps, gains, feedforward)
        lower, gap, gain, link = (
            i.reshape(-1) for i in torch.meshgrid(*(torch.arange(x.shape[1]) for x in axes), indexing="ij")
        )
        k = gains[:, gain]
        if self.gains_of_gap is not None:
            follow = [[list(self.gains_of_gap(g)) for g in row] for row in gaps.tolist()]
            k = torch.tensor(follow, dtype=torch.float64)[:, gap]
        setting = Setting(
            T_hat[:, lower], K_hat[:, lower], T_d[:, lower], K_d[:, lower], gaps[:, gap], k, feedforward[:, link]
        )
        priced_default = column if self.gains_of_gap is None else column.replace(gains=k)
        cost = intrusiveness(setting, priced_default, model_wrong[:, None] & (lower == 0))
        cost = cost + SWITCH * setting.differs(current[:, None])
        on_offer = fresh[:, lower] & new_gap[:, gap] & new_gains[:, gain] & new_link[:, link]
        return Candidates(setting, torch.where(on_offer, cost, torch.inf))


def _axis(now: Tensor, default: Tensor, listed: Tensor) -> tuple[Tensor, Tensor]:
    """What is in force, the default and what is listed, (scenario, value, ...); and which are not there before."""
    values = torch.cat([now[:, None], default[:, None], listed], dim=1)
    new = torch.ones(values.shape[:2], dtype=torch.bool)
    for i in range(2):
        differs = (values[:, i + 1 :] - values[:, i, None]).abs() > 1e-9
        new[:, i + 1 :] &= differs if values.ndim == 2 else differs.any(dim=-1)
    return values, new


def _listed(values: Sequence[Any], scenarios: int, *shape: int) -> Tensor:
    """A list of numbers, or of triples with `shape` 3, the same for every scenario."""
    return (
        torch.tensor([list(v) if shape else v for v in values], dtype=torch.float64)
        .reshape(-1, *shape)
        .expand(scenarios, -1, *shape)
    )
