"""Time of each detector's first alarm, for any threshold, from one pass over the beliefs.

Up to its first alarm a detector's path does not depend on its threshold: nothing was accepted, no window was kept out
of the baseline and no chart was restarted. So one pass with unreachable thresholds gives the whole operating curve, and
each detector is scored as if it ran alone. Windows after a first alarm are not used.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from avtorch.decision.charts import CHARTS, WEIGHT, Chart, ChartKind, chart_limit
from avtorch.decision.divergence import DIVERGENCES, Gaussian, divergence_p_value, innovation
from benchmarks.detectors.drives import Beliefs

_RATES = tuple(10.0**-k for k in (1, 1.5, 2, 2.5, 3, 3.5, 4, 5, 6, 8, 10, 15, 20, 30, 40))
_ARLS = (20.0, 50.0, 100.0, 200.0, 500.0, 1e3, 2e3, 5e3, 1e4, 3e4, 1e5, 1e6, 1e7, 1e8)


@dataclass(frozen=True)
class Detector:
    """A detector with its one tuning parameter: name, default, the values tried from most to least sensitive, and the
    least score that alarms at each."""

    name: str
    tuned: str
    default: float
    values: tuple[float, ...]
    limit: Callable[[float], float]


def _chart(kind: ChartKind) -> Callable[[float], float]:
    factor = math.sqrt(WEIGHT / (2.0 - WEIGHT)) if kind == "ewma" else 1.0
    return lambda arl: factor * chart_limit(kind, 2.0 * arl)


DETECTORS: dict[str, Detector] = {
    "stability": Detector(
        "stability",
        "stability_level",
        0.9,
        (0.999, 0.99, 0.97, 0.95, 0.9, 0.8, 0.7, 0.5, 0.2),
        lambda p: 1.0 - p + 1e-9,
    ),
    "accepted_change": Detector(
        "accepted_change", "certainty", 0.9, (0.05, 0.2, 0.5, 0.7, 0.8, 0.9, 0.95, 0.99, 0.999), lambda c: c
    ),
    **{k: Detector(k, "false_alarm_rate", 0.002, _RATES, lambda rate: -math.log10(rate)) for k in DIVERGENCES},
    **{k: Detector(k, "arl", 500.0, _ARLS, _chart(k)) for k in CHARTS},
}


def scores(beliefs: Beliefs, unevenness: tuple[float, float] = (0.0, 0.0)) -> dict[str, Tensor]:
    """Each detector's score (window, run), the higher the more alarmed; -inf where the window was not used.

    `unevenness` as `Monitor` takes it.
    """
    windows, runs = beliefs.used.shape
    spread = beliefs.belief.cov + torch.diag(torch.tensor(unevenness, dtype=torch.float64) ** 2)
    charts = {kind: Chart(kind, runs) for kind in CHARTS}
    for chart in charts.values():
        chart.edge = math.inf  # never restarted
    baseline = Gaussian(beliefs.belief.mean[0], spread[0])
    known = torch.zeros(runs, dtype=torch.bool)
    out: dict[str, list[Tensor]] = {name: [] for name in DETECTORS}
    for i in range(windows):
        window, used = Gaussian(beliefs.belief.mean[i], spread[i]), beliefs.used[i]
        compared, against = used & known, _where(known, baseline, window)
        out["stability"].append(_used(1.0 - beliefs.p_stable[i], used))
        out["accepted_change"].append(_used(beliefs.sure[i], used))
        for kind in DIVERGENCES:
            p = divergence_p_value(kind, window, against).clamp_min(1e-300)
            out[kind].append(_used(-p.log10(), compared))
        z = innovation(window, against)
        for kind, chart in charts.items():
            chart.step(z, compared)
            out[kind].append(_used(chart.last_statistic.amax(-1), compared))
        baseline = _where(used, _where(known, baseline.combine(window), window), baseline)
        known = known | used
    return {name: torch.stack(rows) for name, rows in out.items()}


def first_alarm(score: Tensor, end_s: Tensor, limit: float) -> Tensor:
    """Time of the first window (window, run) whose score is beyond `limit`, (run,) [s]; inf where there is none."""
    return torch.where(score > limit - 1e-12, end_s[:, None], torch.inf).amin(0)


def _used(score: Tensor, where: Tensor) -> Tensor:
    return torch.where(where, score, -torch.inf)


def _where(where: Tensor, a: Gaussian, b: Gaussian) -> Gaussian:
    return Gaussian(torch.where(where[:, None], a.mean, b.mean), torch.where(where[:, None, None], a.cov, b.cov))
