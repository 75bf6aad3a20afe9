"""Stability regions in the plane and the box of the gains (paper, Figs. "timpact" and "taoimpact", Section 2.1).

The paper shows regions "as a function of control gain settings" without naming its axes, so the size of a region is
computed here over all three gains: the share of the box k_s in (0, 3], k_v in [0, 6], k_a in [-6, 0] that is stable,
local and string together. A region is drawn in four ways:

- `print`: Eqs. 2 and 3 over the bounds, as printed;
- `rigorous`: every vehicle within the bounds meets them (`avtorch.vehicle.stability.conditions`);
- `exact`: each of 9 x 9 vehicles within the bounds is string stable by the exact condition;
- `posterior`: P(string stable) is at least 0.95 under the draws of a belief, by the exact condition. The belief is that
  of a vehicle at the bounds' upper lag (or the nominal one) with K_L = 1, after ten windows of 5 s.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from avtorch.paper.drive import Progress, ten_windows
from avtorch.paper.leaders import Ahead, Leaders
from avtorch.paper.rows import MOST, ClaimRow, middle, sign, spread
from avtorch.vehicle.stability import (
    local_conditions,
    local_stable,
    p_locally_and_string_stable,
    string_conditions,
    string_stable,
)

FORMS = ("print", "rigorous", "exact", "posterior")
GAIN_BOUNDS, WIDE_GAIN_BOUNDS = (0.7, 1.0), (0.4, 1.0)
LAG_BOUNDS = (0.1, 0.4)
"""Design bounds of K_L [-] and T_L [s] (paper, Strategy 1)."""

K_S = 1.5
_BOX = ((0.0, 3.0), (0.0, 6.0), (-6.0, 0.0))
_SIDE, _PLANE, _DRAWS, _VEHICLES = 16, 61, 100, 9


@dataclass(frozen=True)
class Panel:
    """One panel of the paper: bounds of lag [s] and gain, time gap [s], and the lag [s] of the vehicle believed in."""

    title: str
    lag: tuple[float, float]
    time_gap: float
    believed: float
    gain: tuple[float, float] = GAIN_BOUNDS


CASES = (
    Panel("$T_L$ in [0, 0.1] s", (0.0, 0.1), 1.0, 0.1),
    Panel("$T_L$ in [0, 1] s", (0.0, 1.0), 1.0, 1.0),
    Panel(r"$\tau$ = 2 s", LAG_BOUNDS, 2.0, 0.3),
    Panel(r"$\tau$ = 0.5 s", LAG_BOUNDS, 0.5, 0.3),
)

_WIDER = Panel("$K_L$ in [0.4, 1]", (0.0, 0.1), 1.0, 0.1, WIDE_GAIN_BOUNDS)
"""Compared with the first case: the paper's claim about K_L."""


@dataclass(frozen=True)
class Regions:
    """`k_v`, `k_a`: axes of the pictures' plane, at k_s = 1.5. `local`, `string`: masks by case and form, (k_a, k_v).

    `shares`: by case and form the share of the box of gains that is stable, (1,), for the posterior (seed,). `passed`,
    `betrayed`: by case, how many gains of the box the printed conditions pass, and how many of those leave a vehicle of
    the bounds string unstable. `wider`: shares by form with wider bounds of K_L.
    """

    ahead: Ahead
    k_v: Tensor
    k_a: Tensor
    local: list[dict[str, Tensor]]
    string: list[dict[str, Tensor]]
    shares: list[dict[str, Tensor]]
    passed: list[int]
    betrayed: list[int]
    wider: dict[str, float]

    @property
    def rows(self) -> list[ClaimRow]:
        pairs = [self._row(form, first) for first in (0, 2) for form in FORMS]
        return [*pairs, *(self._less(form) for form in ("print", "exact")), self._sufficient()]

    def _row(self, form: str, first: int) -> ClaimRow:
        one, other = self.shares[first][form], self.shares[first + 1][form]
        ratio = other / one
        by_lag, random = first == 0, form == "posterior"
        value = float(middle(ratio))
        interval = spread(ratio) if random else None
        cars = f"a vehicle with T_L {CASES[first].believed:g} s" + (
            f" and then {CASES[first + 1].believed:g} s" if by_lag else ""
        )
        way = {
            "print": "Eqs. 2 and 3 as printed",
            "rigorous": "every vehicle of the bounds held to Eqs. 2 and 3",
            "exact": "every vehicle of the bounds string stable by the exact condition",
            "posterior": f"P(string stable) at least {MOST:g} under the belief about {cars}",
        }[form]
        why = f"the stable share of the gains goes from {float(middle(one)):.3f} to {float(middle(other)):.3f}: {way}."
        what = "T_L in [0, 1] s against [0, 0.1] s" if by_lag else "time gap 0.5 s against 2 s"
        where = f"behind {self.ahead.name}" if random else "K_L in [0.7, 1]"
        return ClaimRow(
            "regions",
            f"{what}; {form}; {where}",
            "stable share of the box of gains, second over first",
            "shrinks (below 1)",
            value,
            interval,
            sign(interval or value, below=1.0),
            self.ahead.with_note(why) if random else why,
        )

    def _less(self, form: str) -> ClaimRow:
        """ "K_L was seen to exhibit an impact on the stability region, yet to a less extent than T_L"."""
        first, long = (float(self.shares[i][form]) for i in (0, 1))
        kept, kept_lag = self.wider[form] / first, long / first
        return ClaimRow(
            "regions",
            f"K_L down to 0.4 in place of 0.7, T_L up to 1 s in place of 0.1 s; {form}",
            "share kept as the bounds of K_L widen, less that kept as those of T_L do",
            "K_L has less impact than T_L (above 0)",
            kept - kept_lag,
            None,
            sign(kept - kept_lag, above=0.0),
            f"of the stable share {100 * kept:.0f} % are left when K_L may fall to 0.4, "
            f"{100 * kept_lag:.0f} % when T_L may rise to 1 s.",
        )

    def _sufficient(self) -> ClaimRow:
        passed, betrayed = sum(self.passed), sum(self.betrayed)
        return ClaimRow(
            "regions",
            f"all {len(CASES)} panels; print",
            "share of the gains passed that leave a vehicle of the bounds string unstable",
            0.0,
            betrayed / passed,
            None,
            "same" if betrayed == 0 else "not reproduced",
            f"of {passed} gains that the printed Eqs. 2 and 3 pass, {betrayed} leave one of {_VEHICLES**2} vehicles of "
            "the bounds string unstable by the exact condition.",
        )


def regions(leaders: Leaders, *, seeds: int, seed: int, progress: Progress = lambda _: None) -> Regions:
    """The four panels of the paper, each in four ways; posteriors of `seeds` noises behind the sweep's first leader.

    Example:
        >>> from avtorch.paper import Leaders, regions
        >>> found = regions(Leaders.read(), seeds=2, seed=0)
        >>> sum(found.betrayed) <= sum(found.passed)  # of the gains that the print passes, some betray it
        True
    """
    ahead = leaders.sweep[0]
    beliefs = _beliefs(ahead, seeds, seed, lambda x: progress(0.5 * x))
    box = torch.cartesian_prod(*(_midpoints(*side, _SIDE) for side in _BOX))
    k_v, k_a = (torch.linspace(*side, _PLANE, dtype=torch.float64) for side in _BOX[1:])
    plane = torch.stack(
        [torch.full((_PLANE, _PLANE), K_S, dtype=torch.float64), *torch.meshgrid(k_v, k_a, indexing="xy")], -1
    )
    local, string, shares, passed, betrayed = [], [], [], [], []
    for i, case in enumerate(CASES):
        draws = beliefs[case.believed]
        of_plane = {form: _stable(case, plane, form) for form in FORMS[:3]}
        of_plane["posterior"] = _believed(case, plane, draws[0])
        local.append({form: a for form, (a, _) in of_plane.items()})
        string.append({form: a & b for form, (a, b) in of_plane.items()})
        of_box = {form: _both(case, box, form) for form in FORMS[:3]}
        shares.append({form: x.double().mean()[None] for form, x in of_box.items()})
        thinned = draws[:, :: max(1, draws.shape[1] // _DRAWS)]
        likely = [torch.stack(_believed(case, box, one)).all(0) for one in thinned]
        shares[-1]["posterior"] = torch.stack([x.double().mean() for x in likely])
        passed.append(int(of_box["print"].sum()))
        betrayed.append(int((of_box["print"] & ~of_box["exact"]).sum()))
        progress(0.5 + 0.5 * (i + 1) / len(CASES))
    wider = {form: float(_both(_WIDER, box, form).double().mean()) for form in FORMS[:3]}
    return Regions(ahead, k_v, k_a, local, string, shares, passed, betrayed, wider)


def _stable(case: Panel, gains: Tensor, form: str) -> tuple[Tensor, Tensor]:
    """Locally and string stable all over the case's bounds, for `gains` (..., 3)."""
    if form == "exact":
        sides = (torch.linspace(*side, _VEHICLES, dtype=torch.float64) for side in (case.lag, case.gain))
        T, K = torch.cartesian_prod(*sides).unbind(-1)
        k = gains[..., None, :]
        return local_stable(T, K, case.time_gap, k).all(-1), string_stable(T, K, case.time_gap, k).all(-1)
    at = (case.lag, case.gain, case.time_gap, gains)
    return local_conditions(*at, form=form).holds, string_conditions(*at, form=form).holds  # type: ignore[arg-type]


def _both(case: Panel, gains: Tensor, form: str) -> Tensor:
    return torch.stack(_stable(case, gains, form)).all(0)


def _believed(case: Panel, gains: Tensor, draws: Tensor) -> tuple[Tensor, Tensor]:
    """Locally and string stable with probability 0.95 or more, of `gains` (..., 3) under `draws` (draw, 2)."""
    gap = torch.full(gains.shape[:-1], case.time_gap, dtype=torch.float64)
    T, K = draws.unbind(-1)
    local, string = p_locally_and_string_stable(T, K, gap, gains)
    return local >= MOST, string >= MOST


def _beliefs(ahead: Ahead, seeds: int, seed: int, progress: Progress) -> dict[float, Tensor]:
    """By lag [s], draws of (T_L, K_L) after ten windows of 5 s, (seed, draw, 2)."""
    lags = sorted({case.believed for case in CASES})
    T_L = torch.tensor(lags, dtype=torch.float64).repeat_interleave(seeds)
    windows, _ = ten_windows(ahead.leader, T_L, torch.ones_like(T_L), seed=seed, progress=progress)
    draws = windows[-1].belief.draws[..., :2].movedim(0, 1).unflatten(0, (len(lags), seeds))
    return dict(zip(lags, draws, strict=True))


def _midpoints(low: float, high: float, count: int) -> Tensor:
    step = (high - low) / count
    return low + step * (torch.arange(count, dtype=torch.float64) + 0.5)
