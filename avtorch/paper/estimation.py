"""Estimation over a sweep of T_L and a sweep of K_L (paper, Section 3.3, Fig. "sgldexperiments").

Vehicles of every setting and noise follow a recorded leader in one batch; the belief about each is estimated
separately, window by window. Two claims are tested: the truth lies inside the interval, and "the error in estimation
increases when T_L increases, and similarly when K_L decreases".
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from avtorch.paper.drive import FOR_PRIOR, MORE, Progress, ten_windows
from avtorch.paper.leaders import Ahead, Leaders
from avtorch.paper.rows import ClaimRow, bootstrap_runs, middle, number_list, share, sign, spread, within

LAGS = (0.1, 0.2, 0.3, 0.5, 0.8, 1.2, 1.6, 2.0)
"""T_L [s], with K_L = 1."""

GAINS = (1.0, 0.9, 0.8, 0.7, 0.6, 0.5, 0.4)
"""K_L [-], with T_L = 0.3 s."""

COVERAGE = (0.85, 0.95)
"""Bounds in which the coverage of a 90 % interval should lie."""

KNOWN = 0.5
"""Least share of excited windows for a setting to be called known."""


@dataclass(frozen=True)
class Sweep:
    """Behind one leader: `truth` (setting, 2), lags first, then gains; estimates (setting, seed, 2) after the last
    window, and of the seven windows (window, setting, seed): `used`, and whether the interval held the truth, `inside`
    (window, setting, seed, 2). `asked`: RMS of the command over the seven windows [m/s²], (setting, seed).
    """

    ahead: Ahead
    truth: Tensor
    mean: Tensor
    q05: Tensor
    q95: Tensor
    used: Tensor
    inside: Tensor
    asked: Tensor

    @property
    def error(self) -> Tensor:
        """|estimate - truth| after the last window, (setting, seed, 2)."""
        return (self.mean - self.truth[:, None]).abs()

    @property
    def known(self) -> Tensor:
        """Share of the seven windows that were used, (setting,)."""
        return self.used.double().mean((0, 2))


@dataclass(frozen=True)
class Estimation:
    """The sweeps, one a leader; `seed` of the intervals."""

    sweeps: list[Sweep]
    seed: int

    @property
    def rows(self) -> list[ClaimRow]:
        out = [_coverage(self.sweeps, self.seed)] if len(self.sweeps) > 1 else []
        for sweep in self.sweeps:
            out.append(_coverage([sweep], self.seed))
            out.append(_excitation(sweep))
            out += [_growth(sweep, *which, self.seed) for which in _GROWTHS]
        return out


# quantity that grows, its sweep, whether relative to the truth
_GROWTHS = (("T_L", "T_L", False), ("K_L", "K_L", False), ("K_L", "K_L", True), ("T_L", "K_L", False))


def estimation(leaders: Leaders, *, seeds: int, seed: int, progress: Progress = lambda _: None) -> Estimation:
    """`seeds` noises a setting, all settings and noises in one batch a leader.

    Example:
        >>> from avtorch.paper import Leaders, estimation
        >>> rows = estimation(Leaders.read(), seeds=2, seed=0).rows
        >>> rows[0].quantity, round(float(rows[0].ours), 1)
        ('coverage of the 90 % interval', 0.9)
    """
    truth = torch.tensor([(T, 1.0) for T in LAGS] + [(0.3, K) for K in GAINS], dtype=torch.float64)
    sweeps, count = [], len(leaders.sweep)
    for i, ahead in enumerate(leaders.sweep):
        runs = truth.repeat_interleave(seeds, 0)
        windows, asked = ten_windows(
            ahead.leader,
            runs[:, 0],
            runs[:, 1],
            seed=seed * count + i,
            progress=lambda x, i=i: progress((i + x) / count),
        )
        beliefs = [w.belief for w in windows[FOR_PRIOR:]]

        def per_setting(x: Tensor, axis: int = 0) -> Tensor:
            return x.unflatten(axis, (len(truth), seeds))

        inside = [(b.q05[:, :2] <= runs) & (runs <= b.q95[:, :2]) for b in beliefs]
        last = beliefs[-1]
        sweeps.append(
            Sweep(
                ahead,
                truth,
                *(per_setting(x[:, :2]) for x in (last.mean, last.q05, last.q95)),
                used=per_setting(torch.stack([b.excited & b.converged for b in beliefs]), 1),
                inside=per_setting(torch.stack(inside), 1),
                asked=per_setting(torch.stack(asked[FOR_PRIOR:]).square().mean(0).sqrt()),
            )
        )
    return Estimation(sweeps, seed)


def _coverage(sweeps: list[Sweep], seed: int) -> ClaimRow:
    """Over used windows and both parameters; whole runs are resampled, as the windows of one run are dependent."""
    held = torch.cat([(s.inside & s.used[..., None]).double().sum((0, 3)).flatten() for s in sweeps])
    asked = torch.cat([2 * s.used.double().sum(0).flatten() for s in sweeps])
    at = bootstrap_runs(len(held), seed)
    interval = spread(held[at].sum(-1) / asked[at].sum(-1))
    value = float(held.sum() / asked.sum())
    final = torch.cat([s.inside[-1].double().flatten() for s in sweeps])
    why = (
        f"of {int(asked.sum())} intervals of T_L and K_L in used windows {100 * value:.1f} % held the truth, of the "
        f"{len(final)} after the last window {100 * float(final.mean()):.1f} %; the aim is "
        f"{100 * COVERAGE[0]:.0f} to {100 * COVERAGE[1]:.0f} %."
    )
    ahead = "; ".join(s.ahead.name for s in sweeps)
    return ClaimRow(
        "estimation",
        f"{MORE} windows of 5 s, all settings; {ahead}",
        "coverage of the 90 % interval",
        "the truth lies within the bounds",
        value,
        interval,
        within(value, *COVERAGE),
        sweeps[0].ahead.with_note(why),
    )


def _excitation(sweep: Sweep) -> ClaimRow:
    known = sweep.known
    too_few = known < KNOWN
    value = float((~too_few).double().mean())
    lags, gains = len(LAGS), too_few.tolist()
    named = [
        f"{name} {number_list([x for x, p in zip(values, flags, strict=True) if p])}{unit}"
        for name, values, flags, unit in (("T_L", LAGS, gains[:lags], " s"), ("K_L", GAINS, gains[lags:], ""))
        if any(flags)
    ]
    excitation = (
        "every setting has excited windows in at least half"
        if not named
        else f"fewer than half are excited for {' and for '.join(named)}: too few to know those well"
    )
    least, most = (100 * float(x) for x in (known.min(), known.max()))
    why = f"of the {MORE} windows after the prior {least:.0f} to {most:.0f} % are excited; {excitation}."
    return ClaimRow(
        "estimation",
        f"{len(known)} settings; {sweep.ahead.name}",
        "share of settings with at least half of the windows excited",
        "the model can track both",
        value,
        None,
        share(value),
        sweep.ahead.with_note(why),
    )


def _growth(sweep: Sweep, what: str, along: str, relative: bool, seed: int) -> ClaimRow:
    """The exponent of the median error along the sweep, from a straight line through the logarithms."""
    part = slice(0, len(LAGS)) if along == "T_L" else slice(len(LAGS), None)
    column = ("T_L", "K_L").index(what)
    x = sweep.truth[part, ("T_L", "K_L").index(along)]
    size = sweep.error[part, :, column]
    if relative:
        size = size / sweep.truth[part, None, column]
    medians = middle(size)
    value = float(_slope(x, medians[None])[0])
    again = bootstrap_runs(size.shape[1], seed)
    interval = spread(_slope(x, middle(size[:, again]).mT))
    verdict = sign(interval, above=0.0) if along == "T_L" else sign(interval, below=0.0)
    ends = medians[[0, -1]].tolist()
    asked = middle(sweep.asked[part])
    unit = " s" if what == "T_L" and not relative else ""
    words = f"relative error of {what}" if relative else f"error of {what}"
    why = (
        f"the median {words} goes from {ends[0]:.2g}{unit} at {along} {float(x[0]):g} to {ends[1]:.2g}{unit} at "
        f"{float(x[-1]):g}, while the command's RMS goes from {float(asked[0]):.2f} to {float(asked[-1]):.2f} m/s²."
    )
    falls = along == "K_L"
    return ClaimRow(
        "estimation",
        f"{along} from {float(x[0]):g} to {float(x[-1]):g}; {sweep.ahead.name}",
        f"exponent of the {words} in {along}",
        "the error grows as K_L falls (below 0)" if falls else "the error grows with T_L (above 0)",
        value,
        interval,
        verdict,
        sweep.ahead.with_note(why),
    )


def _slope(x: Tensor, y: Tensor) -> Tensor:
    """Of log y (..., setting) against log x (setting,)."""
    u = x.log() - x.log().mean()
    return (u * y.clamp_min(1e-12).log()).sum(-1) / u.square().sum()
