"""The effect of each gain (paper, Table 2 and Section 4, Strategy 3), by experiment.

Each gain in turn is made 1.5, 2 and 3 times as large, the others kept, behind the main leader, with the healthy vehicle
under the same noises. The table's words and how they are measured:

- k_s "maintain the target spacing": RMS of the spacing error falls; "pushes towards neutral behaviour": the time by
  which the speed lags behind the leader's stays within 5 %;
- k_v "match the leader's speed", "responsive": RMS of the speed difference falls, and so does that lag;
- k_a "minimize acceleration", "resists acceleration change": RMS of the acceleration falls, and the lag grows; (text)
  "less responsive to noise": the acceleration caused by the jerk noise falls;
- (text) "an increase in |k_s| or |k_v| will prompt the controller to dampen disturbances and regain stability", k_v
  more than k_s: the exact peak gain of the changed vehicle falls.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from avtorch.paper.drive import CHANGED, HEALTHY, NOISE, Progress, noise_seeds
from avtorch.paper.leaders import DRIVE_S, Ahead, Leaders
from avtorch.paper.rows import ClaimRow, ClaimVerdict, median_interval, middle, number_list, sign
from avtorch.vehicle import NOMINAL_GAINS, ClosedLoop, GLVDPlant, LinearController
from avtorch.vehicle.block import Block
from avtorch.vehicle.performance import rms
from avtorch.vehicle.stability import peak_gain

FACTORS = (1.0, 1.5, 2.0, 3.0)
NAMES = ("k_s", "k_v", "k_a")

_LONGEST_LAG_S = 6.0

Goes = Literal["below 1", "above 1", "0.95 to 1.05"]

# gain, measure, bounds of its ratio, the paper's words
_CLAIMS: tuple[tuple[str, str, Goes, str], ...] = (
    ("k_s", "spacing error", "below 1", "maintains the target spacing"),
    ("k_s", "speed lag", "0.95 to 1.05", "pushes towards neutral behaviour"),
    ("k_v", "speed difference", "below 1", "matches the leader's speed"),
    ("k_v", "speed lag", "below 1", "generates responsive behaviour"),
    ("k_a", "acceleration", "below 1", "minimizes acceleration"),
    ("k_a", "speed lag", "above 1", "resists acceleration change, less responsive"),
    ("k_a", "noise in the acceleration", "below 1", "less responsive to noise in acceleration"),
)
_UNITS = {
    "spacing error": "m",
    "speed difference": "m/s",
    "speed lag": "s",
    "acceleration": "m/s²",
    "noise in the acceleration": "m/s²",
}


@dataclass(frozen=True)
class Gains:
    """`measured`: by name, (gain, factor, seed). `peak` (gain, factor): exact, of the changed vehicle. `seed`: of the
    intervals.
    """

    ahead: Ahead
    measured: dict[str, Tensor]
    peak: Tensor
    seed: int

    @property
    def rows(self) -> list[ClaimRow]:
        return [self._claim(*claim) for claim in _CLAIMS] + [self._damps(0), self._damps(1), self._more()]

    def _claim(self, gain: str, what: str, goes: Goes, words: str) -> ClaimRow:
        values = self.measured[what][NAMES.index(gain)]
        ratio = values[-1] / values[0]
        interval = median_interval(ratio, self.seed)
        verdicts: dict[Goes, ClaimVerdict] = {
            "below 1": sign(interval, below=1.0),
            "above 1": sign(interval, above=1.0),
            "0.95 to 1.05": sign(interval, above=0.95, below=1.05),
        }
        steps = ", ".join(f"{x:.3g}" for x in middle(values).tolist())
        why = f"with {gain} at {number_list(FACTORS)} times its value the {what} is {steps} {_UNITS[what]}."
        return ClaimRow(
            "gains",
            f"{gain} three times as large; behind {self.ahead.name}",
            f"{what}, over that with the default gain",
            f"{words} ({goes})",
            float(middle(ratio)),
            interval,
            verdicts[goes],
            self.ahead.with_note(why),
        )

    def _damps(self, index: int) -> ClaimRow:
        peak = self.peak[index]
        steps = ", ".join(f"{x:.3f}" for x in peak.tolist())
        why = f"with {NAMES[index]} at {number_list(FACTORS)} times its value the peak gain is {steps}."
        ratio = float(peak[-1] / peak[0])
        return ClaimRow(
            "gains",
            f"{NAMES[index]} three times as large, changed vehicle (1.5 s, 0.5), time gap 1 s",
            "exact peak gain, over that with the default gain",
            "dampens disturbances and regains stability (below 1)",
            ratio,
            None,
            sign(ratio, below=1.0),
            why,
        )

    def _more(self) -> ClaimRow:
        k_s, k_v = (self.peak[i, -1] for i in (0, 1))
        return ClaimRow(
            "gains",
            "k_v and k_s three times as large, changed vehicle (1.5 s, 0.5), time gap 1 s",
            "exact peak gain with k_v over that with k_s",
            "k_v is much more impactful than k_s (below 1)",
            float(k_v / k_s),
            None,
            sign(float(k_v / k_s), below=1.0),
            f"the peak gain is {float(k_v):.3f} with k_v and {float(k_s):.3f} with k_s three times as large, "
            f"{float(self.peak[0, 0]):.3f} with neither.",
        )


def gains(leaders: Leaders, *, seeds: int, seed: int, progress: Progress = lambda _: None) -> Gains:
    """All gains, factors and noises in one batch, and one scenario of each setting without noise.

    Example:
        >>> from avtorch.paper import Leaders, gains
        >>> rows = gains(Leaders.read(), seeds=2, seed=0).rows
        >>> len(rows), rows[0].quantity
        (10, 'spacing error, over that with the default gain')
    """
    ahead = leaders.main
    k = torch.tensor(NOMINAL_GAINS, dtype=torch.float64).repeat(len(NAMES), len(FACTORS), 1)
    for i in range(len(NAMES)):
        k[i, :, i] *= torch.tensor(FACTORS, dtype=torch.float64)
    flat = k.reshape(-1, 3)
    each = seeds + 1
    loop = ClosedLoop(
        ahead.leader,
        LinearController(flat.repeat_interleave(each, 0)),
        plant=GLVDPlant(*HEALTHY, sigma=torch.tensor([NOISE] * seeds + [0.0], dtype=torch.float64).repeat(len(flat))),
        scenarios=len(flat) * each,
        seeds=noise_seeds(seed, each) * len(flat),
    )
    blocks = []
    while loop.time < DRIVE_S - 1e-9:
        blocks.append(loop.advance(500))
        progress(loop.time / DRIVE_S)
    run = Block.concatenate(blocks)

    def by_setting(x: Tensor) -> Tensor:
        return x.unflatten(0, (len(NAMES), len(FACTORS), each))

    wanted = 5.0 + run.speed
    noisy = by_setting(run.accel)
    measured = {
        "spacing error": by_setting(rms(run.spacing - wanted)),
        "speed difference": by_setting(rms(run.lead_speed - run.speed)),
        "speed lag": by_setting(_lag(run)),
        "acceleration": by_setting(rms(run.accel)),
    }
    measured = {name: x[..., :seeds] for name, x in measured.items()}
    measured["noise in the acceleration"] = rms(noisy[..., :seeds, :] - noisy[..., seeds:, :])
    peak = peak_gain(CHANGED[0], CHANGED[1], 1.0, k)
    return Gains(ahead, measured, peak, seed)


def _lag(run: Block) -> Tensor:
    """The delay [s] at which the leader's speed fits the follower's best (least squares), (scenario,)."""
    dt = float(run.time[1] - run.time[0])
    steps = range(0, round(_LONGEST_LAG_S / dt) + 1, 5)
    longest = steps[-1]
    own = run.speed[:, longest:]
    misses = torch.stack(
        [(own - run.lead_speed[:, longest - s : run.speed.shape[1] - s]).square().mean(-1) for s in steps]
    )
    return torch.tensor([s * dt for s in steps], dtype=torch.float64)[misses.argmin(0)]
