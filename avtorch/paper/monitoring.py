"""The monitoring experiment (paper, Section 4, Fig. "monitoring"): a vehicle changes at 26 s, monitored in windows of
2 s.

The paper reports one run: 0.24 s and 0.98 before the change (true: 0.3 s and 1), 1.33 s and 0.64 after it (true: 1.5 s
and 0.5), the alert 2 s after it. Here `seeds` runs are monitored without any action. *Before* is the last used window
before the change, *first after* the first used one after it, *after* the mean error over all used windows after it.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from avtorch.decision.supervisor import Supervisor
from avtorch.decision.watch import SupervisedRun
from avtorch.paper.drive import CHANGE_S, CHANGED, HEALTHY, NOISE, Progress, change, noise_seeds
from avtorch.paper.leaders import DRIVE_S, Ahead, Leaders
from avtorch.paper.rows import ClaimRow, error, median_interval, middle, share, spread
from avtorch.vehicle import ClosedLoop, GLVDPlant

WINDOW_S = 2.0
PAPER_BEFORE, PAPER_AFTER = (0.24, 0.98), (1.33, 0.64)
PAPER_ALERT_S = 28.0
_NEVER = 1e9  # [s], where no alert came


@dataclass(frozen=True)
class Watched:
    """One leader's `run`; of its windows `start`, `end` [s] (window,), `mean` (window, seed, 2), `used` (window, seed).

    `alert`: of the first alert after the change [s], (seed,); `early`: one came before it, (seed,).
    """

    ahead: Ahead
    run: SupervisedRun
    start: Tensor
    end: Tensor
    mean: Tensor
    used: Tensor
    alert: Tensor
    early: Tensor

    @property
    def truth(self) -> Tensor:
        """(window, 1, 2)."""
        before, after = (torch.tensor(x, dtype=torch.float64) for x in (HEALTHY, CHANGED))
        return torch.where((self.start >= CHANGE_S - 1e-6)[:, None], after, before)[:, None]

    def rows(self, seed: int) -> list[ClaimRow]:
        after = (self.start >= CHANGE_S - 1e-6)[:, None]
        before, since = self.used & ~after, self.used & after
        last = len(before) - 1 - before.flip(0).int().argmax(0)
        moments = (
            ("before the change", before, last),
            ("in the first window after", since, since.int().argmax(0)),
            ("over all windows after", since, None),
        )
        out = [self._row(column, *moment, seed) for column in range(2) for moment in moments]
        return [*out, self._alert(), self._early()]

    def _row(self, column: int, when: str, seen: Tensor, index: Tensor | None, seed: int) -> ClaimRow:
        """The error of T_L or K_L; `seen` (window, seed); `index` (seed,) of one window, None for the mean over those
        seen."""
        some = seen.any(0)
        paper, truth = (
            (PAPER_BEFORE[column], HEALTHY[column]) if "before" in when else (PAPER_AFTER[column], CHANGED[column])
        )
        theirs = round(abs(paper - truth), 6)
        what = f"error of {('T_L [s]', 'K_L [-]')[column]}"
        setting = f"{when}, {DRIVE_S:g} s, windows of {WINDOW_S:g} s; {self.ahead.name}"
        if not bool(some.any()):
            why = self.ahead.with_note("no window was excited, so the belief is still the first prior.")
            return ClaimRow("monitoring", setting, what, theirs, "not known", None, "not reproduced", why)
        level = self.mean[..., column]
        size = (level - self.truth[..., column]).abs()
        if index is None:
            count = seen.sum(0).clamp_min(1)
            errors, levels = (size * seen).sum(0) / count, (level * seen).sum(0) / count
        else:
            errors, levels = (x.gather(0, index[None])[0] for x in (size, level))
        errors, levels = errors[some], levels[some]
        interval = median_interval(errors, seed)
        why = self.ahead.with_note(
            f"the paper's {paper:g} is {theirs:.2g} off the true {truth:g}; here the median estimate is "
            f"{float(middle(levels)):.3g}, and {int((errors < theirs).sum())} of {int(some.sum())} runs with such a "
            "window are nearer than the paper."
        )
        ours = float(middle(errors))
        return ClaimRow("monitoring", setting, what, theirs, ours, interval, error(theirs, interval), why)

    def _alert(self) -> ClaimRow:
        timely = float((self.alert <= PAPER_ALERT_S + 1e-6).double().mean())
        came = self.alert < _NEVER
        first = self.used & (self.start >= CHANGE_S - 1e-6)[:, None]
        due = torch.where(first.any(0), self.end[first.int().argmax(0)], torch.inf)
        prompt = int((self.alert <= due + 1e-6).sum())
        why = (
            f"the alert came by {PAPER_ALERT_S:g} s in {round(timely * len(came))} of {len(came)} runs, and with "
            f"the first excited window after the change in {prompt}."
        )
        ours: float | str = float(middle(self.alert[came])) if bool(came.any()) else "never"
        return ClaimRow(
            "monitoring",
            f"change at {CHANGE_S:g} s; {self.ahead.name}",
            "time of the alert [s]",
            PAPER_ALERT_S,
            ours,
            spread(self.alert[came]) if bool(came.any()) else None,
            share(timely),
            self.ahead.with_note(why),
        )

    def _early(self) -> ClaimRow:
        value = float(self.early.double().mean())
        why = f"{int(self.early.sum())} of {len(self.early)} runs had an alert before the change."
        return ClaimRow(
            "monitoring",
            f"before {CHANGE_S:g} s; {self.ahead.name}",
            "share of runs with a false alarm",
            0.0,
            value,
            None,
            share(1.0 - value),
            self.ahead.with_note(why),
        )


@dataclass(frozen=True)
class Monitoring:
    """The monitored runs, one per leader; `seed` of the intervals."""

    watched: list[Watched]
    seed: int

    @property
    def rows(self) -> list[ClaimRow]:
        return [row for one in self.watched for row in one.rows(self.seed)]


def monitoring(leaders: Leaders, *, seeds: int, seed: int, progress: Progress = lambda _: None) -> Monitoring:
    """`seeds` noises behind each of the leaders' `drives`.

    Example:
        >>> from avtorch.paper import Leaders, monitoring
        >>> rows = monitoring(Leaders.read(), seeds=2, seed=0).rows
        >>> rows[0].quantity, rows[0].ours < 0.1
        ('error of T_L [s]', True)
    """
    count = len(leaders.drives)
    found = []
    for i, ahead in enumerate(leaders.drives):
        loop = ClosedLoop(
            ahead.leader, plant=GLVDPlant(*HEALTHY, sigma=NOISE), scenarios=seeds, seeds=noise_seeds(seed, seeds)
        )
        run = Supervisor(loop, window=WINDOW_S, seed=seed).run(
            DRIVE_S,
            events=[(CHANGE_S, change)],
            progress=lambda done, of, i=i: progress((i + done / of) / count),
        )
        found.append(_read(ahead, run))
    return Monitoring(found, seed)


def _read(ahead: Ahead, run: SupervisedRun) -> Watched:
    windows = [w.window for w in run.windows]
    late = [[a.time_s for a in alerts if a.time_s > CHANGE_S + 1e-6] for alerts in run.alerts]
    return Watched(
        ahead,
        run,
        start=torch.tensor([w.start_s for w in windows]),
        end=torch.tensor([w.end_s for w in windows]),
        mean=torch.stack([w.belief.mean[:, :2] for w in windows]),
        used=torch.stack([w.belief.excited & w.belief.converged for w in windows]),
        alert=torch.tensor([min(times, default=_NEVER) for times in late]),
        early=torch.tensor([any(a.time_s <= CHANGE_S + 1e-6 for a in alerts) for alerts in run.alerts]),
    )
