"""Is the repaired plant string stable, and which setting makes it so with the least intrusion?

The complete repaired plant, with its dead time, second pole or late sensor, is evaluated in the loop at slow, usual and
quick speeds and for driving and braking; a draw of its parameters counts as stable where it is stable in all of these.
Settings and their costs are the strategist's (`avtorch.decision.grid`), with calmer gains added. A setting that would
have clipped more than one in twenty of the log's commands is excluded.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import product
from typing import Any

import numpy as np
import torch
from torch import Tensor

from avtorch.arrays import FloatArray
from avtorch.decision import Setting
from avtorch.decision.algorithm2 import ACCEPTED_CHANGE
from avtorch.decision.grid import GAINS_GRID, Grid
from avtorch.display import Card, Displayed, Frame
from avtorch.errors import InputError
from avtorch.gap import GapPlant
from avtorch.gap.linearised import linearised
from avtorch.gap.result.diagnosis import Diagnosis
from avtorch.gap.simulator.effect_response import is_linear, is_one_sided
from avtorch.vehicle.stability import Chain, chain_verdict

SOFTER: tuple[tuple[float, float, float], ...] = tuple(product((0.1, 0.2, 0.4, 0.8), (0.4, 0.7, 1.0), (-0.8, -0.2)))
"""Gains on offer besides the strategist's: a loop with dead time needs calmer gains and a longer gap."""
SPEEDS_MPS = (5.0, 15.0, 30.0)
STEP_MPS2 = 0.5
_LIMITS_MPS2 = (-6.0, 4.0)  # beyond which a command is clipped
_BLOCK = 32  # settings evaluated at a time


@dataclass(frozen=True, eq=False, repr=False)
class WhatToSet(Displayed):
    """`p_now`, `p_then`: P(string stable) with the setting in force and with the one to `set`.

    `p_assumed`: of the simulator as it was, without the effect. `peaks` of these three, as `assumed`, `in_force` and
    `then`: median, 5 and 95 % quantile of the peak gain [-] at the worst of speeds and pedals, inf where disturbances
    grow. `clipped`: share of the log's commands that `set` would have clipped. `strategies` out of 1 (lower level), 2
    (time gap), 3 (gains), 4 (feed-forward). `notes`: what holds for steps of one size only.
    """

    in_force: Setting = field(repr=False)
    set: Setting = field(repr=False)
    p_assumed: float
    p_now: float
    p_then: float
    peaks: Mapping[str, tuple[float, float, float]]
    required: float
    strategies: tuple[int, ...]
    clipped: float
    notes: tuple[str, ...] = ()

    @property
    def sufficient(self) -> bool:
        """Whether `p_then` reaches `required`."""
        return self.p_then >= self.required

    @property
    def peak_now(self) -> float:
        """The median peak gain [-] with the setting in force."""
        return self.peaks["in_force"][0]

    @property
    def peak_then(self) -> float:
        """The median peak gain [-] with the one to `set`."""
        return self.peaks["then"][0]

    def overview(self) -> Card:
        """What to set and why; P(string stable) and peak gain with each setting."""
        table = Frame(
            {
                "": ["simulator as it was", "setting in force", "setting to use"],
                "P(string stable)": [self.p_assumed, self.p_now, self.p_then],
                "peak gain [-]": [self.peaks["assumed"][0], self.peak_now, self.peak_then],
            }
        )
        return Card("What to set", (self.why,), table)

    def to_dict(self) -> dict[str, Any]:
        """As plain numbers; a peak gain that is infinite is null."""
        return {
            "in_force": self.in_force.as_dict(),
            "settings": self.set.as_dict(),
            "strategies": list(self.strategies),
            "p_string_stable": {"assumed": self.p_assumed, "in_force": self.p_now, "then": self.p_then},
            "peak_gain": {
                name: dict(zip(("median", "q05", "q95"), map(_finite, quantiles), strict=True))
                for name, quantiles in self.peaks.items()
            },
            "required": self.required,
            "sufficient": self.sufficient,
            "clipped_share": self.clipped,
            "why": self.why,
            "notes": list(self.notes),
        }

    @property
    def why(self) -> str:
        """What to set, and what comes of it, in a sentence."""
        steps = []
        s = self.set.as_dict()
        if 1 in self.strategies:
            model = f"a lower level that models T {s['T_hat']:.2f} s and K {s['K_hat']:.2f}"
            steps.append(f"{model} and targets a lag of {s['T_d']:.2f} s")
        if 2 in self.strategies:
            steps.append(f"time gap {s['time_gap_s']:g} s instead of {self.in_force.as_dict()['time_gap_s']:g} s")
        if 3 in self.strategies:
            steps.append("gains " + ", ".join(f"{k:g}" for k in s["gains"]))
        if 4 in self.strategies:
            steps.append(f"feed the leader's acceleration forward with k_f {s['feedforward']:g}")
        if not steps and self.sufficient:
            return (
                "Nothing to set: as it is, disturbances die out along a line of such cars with probability "
                f"{self.p_now:.2f} (string stability)."
            )
        if not steps:
            return (
                "no available setting lets disturbances die out along a line of such cars (string stability), and none "
                f"is better than the one in force (probability that they do: {self.p_now:.2f})."
            )
        what = "; ".join(steps)
        change = f"probability of string stability {self.p_then:.2f} instead of {self.p_now:.2f}"
        if self.sufficient:
            return f"{what} ({change}); the least intrusive setting that is sufficient."
        return f"no available setting reaches {self.required:g}; the best is {what} ({change})."


def what_to_set(
    plant: GapPlant,
    belief: Mapping[str, FloatArray | Tensor],
    *,
    assumed: Mapping[str, FloatArray | Tensor] | None = None,
    commands: Sequence[float] | FloatArray | None = None,
    in_force: Setting | None = None,
    grid: Grid | None = None,
    required: float = 0.95,
) -> WhatToSet:
    """The least intrusive setting that makes `plant` string stable with probability `required`.

    `belief`: draws (draw,) of the plant's parameters by its names (`T_L`, `K_L`, `effect.parameter`); `assumed`: draws
    of `T_L` [s] and `K_L` of the simulator without the effect. `commands` (row,) [m/s²]: a log's, in which clipping is
    counted. Default setting in force: time gap 1 s, the paper's gains, the lower level passing through. `grid`: what is
    on offer. Raises `InputError` for a probability out of range.
    """
    if not 0.0 < required < 1.0:
        raise InputError(f"required: found {required}, needs a number between 0 and 1")
    draws = {k: torch.as_tensor(np.asarray(v), dtype=torch.float64) for k, v in belief.items()}
    now = Setting(scenarios=1) if in_force is None else in_force
    chains = _chains(plant, draws)
    T, K = (draws[name].mean().reshape(1) for name in ("T_L", "K_L"))
    # a model within the paper's accepted change is not known to be wrong
    stale = ((T - now.T_hat).abs() > ACCEPTED_CHANGE[0]) | ((K - now.K_hat).abs() > ACCEPTED_CHANGE[1])
    offers = (Grid(gains=(*GAINS_GRID, *SOFTER)) if grid is None else grid).candidates(
        T, K, current=now, default=now, model_wrong=stale
    )
    cost = offers.cost[0]
    order = [i for i in cost.argsort(stable=True).tolist() if bool(torch.isfinite(cost[i]))]
    clipped = _clipped(offers.setting[0], np.zeros(0) if commands is None else np.asarray(commands, float))

    p, peaks = _string_stability(chains, now)
    p_now, now_at = float(p[0]), _quantiles(peaks[0])
    best, p_best, then_at = 0, p_now, now_at
    for first in range(0, len(order) if p_now < required else 0, _BLOCK):
        some = order[first : first + _BLOCK]
        p, peaks = _string_stability(chains, offers.setting[0][torch.tensor(some)])
        good = [k for k, i in enumerate(some) if p[k] >= required and clipped[i] <= 0.05]
        if good:
            best, p_best, then_at = some[good[0]], float(p[good[0]]), _quantiles(peaks[good[0]])
            break
        allowed = torch.tensor([clipped[i] <= max(0.05, clipped[0]) for i in some])
        top = int(torch.where(allowed, p, -1.0).argmax())
        if bool(allowed[top]) and float(p[top]) > p_best + 0.02:
            best, p_best, then_at = some[top], float(p[top]), _quantiles(peaks[top])
    chosen = offers.setting[0][torch.tensor([best])]
    bare = GapPlant((), T_L=plant.T_L, K_L=plant.K_L, sigma=0.0)
    thought = {k: torch.as_tensor(np.asarray(v), dtype=torch.float64) for k, v in (assumed or {}).items()}
    p_thought, thought_at = _string_stability(_chains(bare, thought or draws), now)
    at = {"assumed": _quantiles(thought_at[0]), "in_force": now_at, "then": then_at}
    names = [e.name for e in plant.effects if not is_linear(e)]
    notes = (f"{' and '.join(names)}: evaluated for steps of {STEP_MPS2:g} m/s².",) if names else ()
    return WhatToSet(
        in_force=now,
        set=chosen,
        p_assumed=float(p_thought[0]),
        p_now=p_now,
        p_then=p_best,
        peaks=at,
        required=required,
        strategies=tuple(sorted(chosen.strategies(now)[0])),
        clipped=float(clipped[best]),
        notes=notes,
    )


def setting_for(
    found: Diagnosis, commands: Sequence[float] | FloatArray | None = None, **more: Any
) -> WhatToSet | None:
    """Call `what_to_set` for the car of a diagnosis; None where the verdict is `unknown`.

    `commands` (row,) [m/s²]: the log's. `more`: `in_force`, `grid`, `required`, as in `what_to_set`, which raises
    `InputError` for a probability out of range.

    Example:
        >>> from avtorch import Leader, diagnose, simulate
        >>> from avtorch.gap import DeadTime, plant
        >>> from avtorch.remedy import setting_for
        >>> late = plant([DeadTime(0.4)], sigma=0.0)
        >>> log = simulate(Leader.default(start=50.0, duration=30.0, dt=0.1), plant=late).log()
        >>> answer = setting_for(diagnose(log, effects=["dead_time"], pairs=False), log.accel_cmd)
        >>> round(answer.p_now, 2), answer.sufficient
        (0.0, True)
    """
    if found.verdict.abstained or found.simulator is None or found.belief is None:
        return None
    car = found.simulator if found.plant is None else found.plant
    return what_to_set(car, found.belief, assumed=found.assumed, commands=commands, **more)


def _chains(plant: GapPlant, draws: Mapping[str, Tensor]) -> list[Chain]:
    """Chains at every speed; driving and braking separately where the plant responds differently to them."""
    bends = any(is_one_sided(e) for e in plant.effects)
    at = SPEEDS_MPS if any(e.needs_speed for e in plant.effects) else SPEEDS_MPS[:1]
    steps = (STEP_MPS2, -STEP_MPS2) if bends else (STEP_MPS2,)
    return [linearised(plant, draws, speed=v, step=u) for v in at for u in steps]


def _string_stability(chains: Sequence[Chain], settings: Setting) -> tuple[Tensor, Tensor]:
    """P(string stable) (setting,) and the peak gain (setting, draw), each draw at its worst chain."""
    # the lower level's command per unit of sensed and of demanded acceleration
    zero, one = torch.zeros_like(settings.T_hat), torch.ones_like(settings.T_hat)
    lower = settings.lower_level(accel_min=-1e9, accel_max=1e9)
    inner, forward = lower.raw_command(one, zero), lower.raw_command(zero, one)
    verdicts = [
        chain_verdict(
            chain,
            settings.time_gap[:, None],
            settings.gains[:, None],
            inner=inner[:, None],
            forward=forward[:, None],
            feedforward=settings.feedforward[:, None],
        )
        for chain in chains
    ]
    stable = torch.stack([verdict.string_stable for verdict in verdicts]).all(0)
    return stable.double().mean(-1), torch.stack([verdict.peak_gain for verdict in verdicts]).amax(0)


def _quantiles(peak: Tensor) -> tuple[float, float, float]:
    """Median, 5 and 95 % quantile over draws (draw,), of which some may be inf."""
    # by rank: between a number and inf there is nothing to interpolate
    low, middle, high = torch.quantile(peak, torch.tensor([0.05, 0.5, 0.95]).to(peak), interpolation="nearest").tolist()
    return middle, low, high


def _clipped(settings: Setting, commands: FloatArray) -> list[float]:
    """Share of the log's commands that each setting would have clipped, scaled by its inversion."""
    if not len(commands):
        return [0.0] * len(settings.T_hat)
    # counted in order: an hour's commands times thousands of settings are gigabytes
    low, high = (np.array(limit) / settings.amplification().numpy() for limit in _LIMITS_MPS2)
    inside = np.searchsorted(np.sort(commands), high, "right") - np.searchsorted(np.sort(commands), low, "left")
    return (1.0 - inside / len(commands)).tolist()


def _finite(x: float) -> float | None:
    return x if np.isfinite(x) else None
