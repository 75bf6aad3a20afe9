"""Ten vehicles behind one leader, all changed at 26 s, with and without action at 28 s.

The paper monitors one follower and argues for the traffic behind it; a platoon shows how much the action helps there.
Every vehicle gets the same setting: none, one of the paper's, or what the strategist chose for a single follower of the
same leader, free to use all strategies. A collision is recorded but not simulated: a platoon's motion after one is no
longer physical, and a row reports it.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from avtorch.decision.settings import Setting
from avtorch.paper.drive import ACT_S, CHANGED, Progress, drive, rows_from, stacked
from avtorch.paper.leaders import PLATOON_S, Ahead, Leaders
from avtorch.paper.rows import ClaimRow, median_interval, middle, sign
from avtorch.paper.strategies import AS_BUILT, PRINTED, supervise
from avtorch.vehicle.block import Block
from avtorch.vehicle.performance import rms, rms_about_mean

VEHICLES = 10
PASSED_S = 80.0
"""When the disturbance of ten opening gaps has passed all ten vehicles [s]: it takes up to 2.5 s, a time gap, per
vehicle."""

MOST_SEEDS = 5
"""Maximum number of noises: they hardly move a platoon, and each takes 12 MB of rows per setting."""

_WHOLE_S = 46.0  # long enough for the strategist's first choices


@dataclass(frozen=True)
class Platoon:
    """`run` (setting, seed, vehicle, time), settings in the order of `names`; exact `peak` (setting,) at the truth."""

    ahead: Ahead
    names: tuple[str, ...]
    settings: Setting
    run: Block
    peak: Tensor
    seed: int

    def against_leader(self, what: str, start: float) -> Tensor:
        """RMS of `accel`, or of `speed` about its mean, over the leader's from `start` [s] on; by vehicle, last."""
        rows = rows_from(self.run, start)
        measure = rms if what == "accel" else rms_about_mean
        first = measure(getattr(rows, f"lead_{what}")[..., :1, :])
        return measure(getattr(rows, what)) / first

    @property
    def rows(self) -> list[ClaimRow]:
        out = []
        for i, name in enumerate(self.names):
            if i > 0:
                out += [self._row(i, name, what) for what in ("accel", "speed")]
            out.append(self._attenuates(i, name))
        return out

    def _row(self, i: int, name: str, what: str) -> ClaimRow:
        tail = self.against_leader(what, ACT_S)[..., -1]
        ratio = tail[i] / tail[0]
        interval = median_interval(ratio, self.seed)
        word = "acceleration" if what == "accel" else "speed about its mean"
        why = (
            f"vehicle {VEHICLES}'s RMS is {float(middle(tail[i])):.2f} times the leader's, without action "
            f"{float(middle(tail[0])):.2f} times; {self._crashes(i)}."
        )
        return ClaimRow(
            "platoon",
            f"{name}; {ACT_S:g} to {PLATOON_S:g} s, behind {self.ahead.name}",
            f"RMS of the last vehicle's {word}, with action / without",
            "calmer (below 1)",
            float(middle(ratio)),
            interval,
            sign(interval, below=1.0),
            self.ahead.with_note(why),
        )

    def _attenuates(self, i: int, name: str) -> ClaimRow:
        """Does the leader's motion die out toward the tail?"""
        speed = self.against_leader("speed", PASSED_S)[i]
        ratio = speed[:, -1] / speed[:, 0]
        interval = median_interval(ratio, self.seed)
        why = (
            f"the exact peak gain of a vehicle is {float(self.peak[i]):.4f}, to the power of {VEHICLES - 1} "
            f"{float(self.peak[i]) ** (VEHICLES - 1):.3g}; {self._crashes(i)}."
        )
        claim = "amplifies (above 1)" if i == 0 else "stability regained (below 1)"
        return ClaimRow(
            "platoon",
            f"{name}; {PASSED_S:g} to {PLATOON_S:g} s, behind {self.ahead.name}",
            "RMS of the speed about its mean, vehicle 10 over vehicle 1",
            claim,
            float(middle(ratio)),
            interval,
            sign(interval, above=1.0) if i == 0 else sign(interval, below=1.0),
            self.ahead.with_note(why),
        )

    def _crashes(self, i: int) -> str:
        hit = (self.run.spacing[i] <= 0).any(-1).any(-1)
        least = float(self.run.spacing[i].min())
        if bool(hit.any()):
            return f"{int(hit.sum())} of {len(hit)} runs hold a collision, and motion after it is not physical"
        return f"least spacing {least:.1f} m"


def platoon(leaders: Leaders, *, seeds: int, seed: int, progress: Progress = lambda _: None) -> Platoon:
    """All settings and noises (`MOST_SEEDS` at most) in one batch.

    Example:
        >>> from avtorch.paper import Leaders, platoon
        >>> rows = platoon(Leaders.read(), seeds=2, seed=0).rows
        >>> rows[0].quantity
        'RMS of the speed about its mean, vehicle 10 over vehicle 1'
    """
    ahead, seeds = leaders.main, min(seeds, MOST_SEEDS)
    chosen = our_setting(ahead, seed, lambda x: progress(0.3 * x))
    named = {
        AS_BUILT: Setting(scenarios=1),
        **PRINTED,
        "our strategist's choice": chosen,
    }
    settings = stacked(list(named.values()))
    run = drive(
        ahead.leader,
        settings,
        seeds=seeds,
        seed=seed,
        duration=PLATOON_S,
        vehicles=VEHICLES,
        progress=lambda x: progress(0.3 + 0.7 * x),
    )
    truth = (torch.full((len(named),), x, dtype=torch.float64) for x in CHANGED)
    return Platoon(ahead, tuple(named), settings, run, settings.peak_gain(*truth), seed)


def our_setting(ahead: Ahead, seed: int, progress: Progress) -> Setting:
    """The setting that the strategist gives a single follower soon after the change, (1,)."""
    found = supervise(ahead, "auto", seeds=1, seed=seed, duration=_WHOLE_S, progress=progress)
    actions = found.actions[0]
    return actions[-1].setting if actions else Setting(scenarios=1)
